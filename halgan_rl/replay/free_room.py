"""Whether memory and disk have room for a frame storage."""

import os
import shutil
from pathlib import Path


def readable(size: float) -> str:
    """A size for people."""
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.4g} {unit}"
        size /= 1000
    return f"{size:.4g} GB"


def check_room(nbytes: int, bookkeeping: int, scratch_dir: Path | None, remedy: str) -> None:
    """Refuses sizes [bytes] that free memory or, with a ``scratch_dir``, its free disk cannot hold."""
    needs = [("memory", nbytes, free_memory())]
    if scratch_dir is not None:
        scratch_dir.mkdir(parents=True, exist_ok=True)
        needs = [
            ("memory", bookkeeping, free_memory()),
            (f"the disk of {scratch_dir}", nbytes - bookkeeping, shutil.disk_usage(scratch_dir).free),
        ]
    for where, needed, free in needs:
        if needed > free:
            raise MemoryError(
                f"FrameStorage needs {readable(needed)} ({needed} bytes) in {where}, {readable(free)} ({free} bytes) "
                f"are free: choose fewer than {remedy}, or another scratch_dir"
            )


def free_memory() -> int:
    """Memory that can be had without swapping [bytes]."""
    meminfo = Path("/proc/meminfo")
    for line in meminfo.read_text().splitlines() if meminfo.exists() else ():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
