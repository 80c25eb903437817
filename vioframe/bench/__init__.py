"""The benchmark harness as a library: back-ends run on tracks, and their results kept."""

from vioframe.bench.results import Row, record
from vioframe.bench.run import BackendRun, backend_row, run_backend

__all__ = ["BackendRun", "Row", "backend_row", "record", "run_backend"]
