"""Child processes that end with their parent, however that ends."""

import atexit
import multiprocessing
import os
import signal
import threading
from typing import Any


class Lifeline:
    """Ends child processes when it is cut, or when this process is gone.

    This process holds one end of a pipe, and the children the other. Its end is closed by :meth:`cut`, by Python at
    exit, or by the system, whatever this process died of. A child that has called :meth:`hold` ends at that moment,
    even amid a long computation.

    Give it to a child among the arguments of its ``multiprocessing.Process``: it pickles at no other time.
    """

    def __init__(self) -> None:
        self._theirs, self._ours = multiprocessing.Pipe(duplex=False)
        # Run before multiprocessing's own hook, which waits for children without limit.
        atexit.register(self._ours.close)

    def __getstate__(self) -> dict[str, Any]:
        return {"_theirs": self._theirs, "_ours": None}

    def hold(self) -> None:
        """Makes this process, a child, end with the lifeline. Call it first of all, in the main thread.

        A terminal sends Ctrl-C to all processes at once. It is ignored here from now on: the parent decides.
        """
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self._ours is not None:  # in a forked child, which has a copy of it
            self._ours.close()
        threading.Thread(target=self._end_when_cut, daemon=True).start()

    def cut(self) -> None:
        """Ends the children, at once."""
        self._ours.close()
        atexit.unregister(self._ours.close)

    def _end_when_cut(self) -> None:
        try:
            self._theirs.recv_bytes()  # nothing is ever sent
        except (EOFError, OSError):
            os._exit(1)
