"""Everything that computes. Imports `formats`, never `msgs_cli`."""

import zlib  # noqa: F401  pycolmap brings its own zlib, and corrupts memory where Python's is loaded after it
