"""Runs scripts in two processes that take them from one queue, so that PyTorch is imported only twice."""

import runpy
import sys
from concurrent.futures import ProcessPoolExecutor


def run(path: str) -> None:
    print(path)
    runpy.run_path(path, run_name="__main__")
    # Otherwise the lines of the two processes alternate
    sys.stdout.flush()


if __name__ == "__main__":
    paths = sys.argv[1:]
    # A script may read its own arguments
    del sys.argv[1:]
    with ProcessPoolExecutor(2) as pool:
        # An error of a script is raised here
        list(pool.map(run, paths))
