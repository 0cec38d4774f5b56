"""Runs scripts one after another in one process, which imports PyTorch once."""

import runpy
import sys

for path in sys.argv[1:]:
    print(path, flush=True)
    sys.argv[1:] = []
    runpy.run_path(path, run_name="__main__")
