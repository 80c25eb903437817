"""The benchmark harness as a library: track sources beyond simulation, and running a back-end on any of them."""

from vioframe.bench.results import Row, backend_row, record, table
from vioframe.bench.run import BackendRun, run_backend

__all__ = ["BackendRun", "Row", "backend_row", "record", "run_backend", "table"]
