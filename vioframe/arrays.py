"""Names for the arrays that everything is made of, and when two images are one."""

import sys
from importlib.util import LazyLoader, find_spec, module_from_spec

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]


def same_image(image: Image, other: Image) -> bool:
    """Whether they are equal to the last bit, for which hardly ever all of both has to be looked at."""
    return np.array_equal(image[::32], other[::32]) and np.array_equal(image, other)


def _leave_for_later(name: str) -> None:
    """Have the module ``numpy.NAME`` there, loaded with the first look into it."""
    full = f"numpy.{name}"
    if full in sys.modules or (spec := find_spec(full)) is None or spec.loader is None:
        return
    spec.loader = LazyLoader(spec.loader)
    sys.modules[full] = module = module_from_spec(spec)
    spec.loader.exec_module(module)
    setattr(np, name, module)


# scipy copies all of numpy's namespace, and would load these with it, of which a flight uses nothing.
_leave_for_later("f2py")
_leave_for_later("testing")
