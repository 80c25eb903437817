"""The benchmark harness as a library: track sources beyond simulation, and running a back-end on any of them."""

from vioframe.bench.run import BackendRun, run_backend

__all__ = ["BackendRun", "run_backend"]
