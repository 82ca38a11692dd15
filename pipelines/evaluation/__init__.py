"""Evaluation: how good a run is, with the truth and without it.

In go the results of a run (`pipelines/run/outcome.py`) and, for figures of error, a data set with the truth. Out come
RUN/evaluation/ (figures, a table, images; `write.py`), the report of a run as one HTML file (`report.py`) and views of
its map as arrays and images (`views.py`). Begin with `evaluate_outcome` in `evaluate.py`: each of its cells has a
function there, or a module of its name beside it.
"""
