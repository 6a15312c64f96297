"""How many threads the linear algebra of a process uses."""

from __future__ import annotations


def one_thread() -> None:
    """Let numpy's and scipy's linear algebra, as far as it is loaded by now, run on one thread.

    For processes whose matrices are small: a second thread then only waits for the first one, and where the machine has
    other work it waits a whole turn of the scheduler each time.  Planning took four times as long that way on two busy
    cores; perception and matching took twice the processor's time.  Networks (torch) keep their threads.  Without
    ``threadpoolctl`` nothing is changed; the environment variable OMP_NUM_THREADS=1 does the same.
    """
    try:
        import scipy.linalg  # noqa: F401  (brings a library of its own)
        from threadpoolctl import threadpool_limits
    except ImportError:
        return
    threadpool_limits(limits=1, user_api="blas")
