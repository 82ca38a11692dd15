"""The command line: parse, call `pipelines`, print."""
