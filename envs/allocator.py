"""How the C library's allocator treats large tensors that come and go."""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_KEPT = (1 << 31) - 1
_PAD = 64 << 20


def keep_freed_memory() -> bool:
    """Keep freed memory in this process instead of giving it back to the system at once.

    Tensors of some megabytes are made and dropped all the time. By default glibc returns their pages, and the system
    clears them again for the next tensor, which takes a fifth of the time of a rollout on a CPU. Memory then falls only
    when the process ends.

    Returns:
        Whether it was done; other C libraries than glibc have no such setting, and nothing is changed.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    options = ((_TRIM_THRESHOLD, _KEPT), (_MMAP_THRESHOLD, _KEPT), (_TOP_PAD, _PAD))
    return min(libc.mallopt(name, value) for name, value in options) == 1
