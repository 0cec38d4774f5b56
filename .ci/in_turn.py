"""Runs scripts one after another in one process, which imports PyTorch once."""

import runpy
import sys

paths = sys.argv[1:]
# A script may read its own arguments
del sys.argv[1:]
for path in paths:
    print(path)
    runpy.run_path(path, run_name="__main__")
    # Otherwise the lines of two processes alternate
    sys.stdout.flush()
