"""One torch thread per test process: the tests run in parallel, and tiny networks gain nothing from more."""

import torch as th

th.set_num_threads(1)
