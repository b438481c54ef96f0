"""Threads: a product of a frame's features takes half a millisecond, too little to share between cores."""

from __future__ import annotations

from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def keep_numpy_single_threaded() -> None:
    """Let NumPy's BLAS compute in the calling thread, from now on, in this process.

    Waiting for a second thread costs a small product more than it gains, and on a busy machine many
    times more: the whole takes as long as its latest thread.  torch and FAISS bring libraries of
    their own, which keep their threads.
    """
    for library in ThreadpoolController().lib_controllers:
        if library.user_api == "blas" and "numpy" in library.filepath:
            library.set_num_threads(1)
