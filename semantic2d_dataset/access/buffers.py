"""Memory of batches, used again once nobody holds the batch."""

from __future__ import annotations

import sys
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_KEPT = 16
_OWN_REFERENCES = 3  # the list's, the loop's, and the argument of getrefcount


class Buffers:
    """Hands out arrays; fresh pages from the kernel cost more than filling a batch does.

    An array comes back by itself: it is handed out again when no other reference to it is left,
    such as that of a tensor over it.
    """

    def __init__(self) -> None:
        self._arrays: list[NDArray[Any]] = []
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[Buffers], tuple[()]]:
        return Buffers, ()

    def take(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return an array of any content that nobody else holds."""
        with self._lock:
            for array in self._arrays:
                fits = array.shape == shape and array.dtype == dtype
                if fits and sys.getrefcount(array) == _OWN_REFERENCES:
                    return array
            self._arrays = [*self._arrays[-_KEPT + 1 :], np.empty(shape, dtype)]
            return self._arrays[-1]
