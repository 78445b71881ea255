"""The process that makes machine code in the background: reads a request, compiles, and ends."""

import os
import sys
from contextlib import suppress

from stiffopt.model.compiled import make_in_background


def main() -> None:
    """Compile what a pickled request on standard input asks for, at low priority."""
    with suppress(OSError):
        os.nice(10)
    make_in_background(sys.stdin.buffer.read())


if __name__ == "__main__":
    main()
