"""Fixtures shared by all tests."""

import hashlib
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def _kernel_cache() -> str:
    """numba reuses a compiled kernel although another it calls has changed; a cache named after all sources cannot."""
    sources = sorted([*(ROOT / "vioframe").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")])
    kernels = [text for text in (source.read_bytes() for source in sources) if b"njit" in text]
    return str(ROOT / ".pytest_cache" / "numba" / hashlib.sha256(b"".join(kernels)).hexdigest()[:16])


os.environ.setdefault("NUMBA_CACHE_DIR", _kernel_cache())

SHARED_DATA = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings that lies beside the checkout; tests that need it skip where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the real recordings in ../shared/data, which are not here")
    return SHARED_DATA
