"""What all programs set up before they begin."""

import platform
import subprocess
import sys

import pytest

_FAULTS = """
import ctypes, resource, threading
from jaxnerf import app

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def fill():
    block = ctypes.CDLL(None).malloc
    block.restype, block.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    free = ctypes.CDLL(None).free
    free.argtypes = [ctypes.c_void_p]
    for step in range(10):
        if step == 1:
            before = faults()
        start = block(SIZE)
        ctypes.memset(start, 1, SIZE)
        free(start)
    print(faults() - before)

SIZE = 40 * 2**20
app._keep_memory()
fill()
thread = threading.Thread(target=fill)
thread.start()
thread.join()
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone gives large blocks back at once")
def test_memory_that_a_step_frees_is_there_for_the_next():
    """Blocks of 40 MiB, again and again, in the main thread and in another: 10,240 pages each."""
    said = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True).stdout
    assert all(int(count) < 2000 for count in said.split()), said
