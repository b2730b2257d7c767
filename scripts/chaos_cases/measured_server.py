"""`solidcloud serve` with one more thread, which gives freed memory back to the system on demand.

How much freed memory the allocator keeps depends on what was freed last. After a flood of requests it
keeps 50 MB, which would hide a leak of 2 MB a minute, or look like one.
Run as a file, with the arguments of `solidcloud`. A byte at the standard input makes the thread
collect garbage and give back memory; it then prints GIVEN_BACK.
"""

import gc
import os
import threading

from solidcloud.server.cli.main import main
from solidcloud.server.runtime.process_heap import give_back_freed_memory

GIVEN_BACK = "memory given back\n"


def _give_back_when_told() -> None:
    """Give back memory for each byte, until the standard input ends. Runs in a thread."""
    # Not sys.stdin: a thread that waits inside it would abort the exit of the interpreter.
    while os.read(0, 1):
        gc.collect()
        give_back_freed_memory()
        os.write(1, GIVEN_BACK.encode())


if __name__ == "__main__":
    threading.Thread(target=_give_back_when_told, name="give-back", daemon=True).start()
    main()
