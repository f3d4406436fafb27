"""Settings of all tests."""

import torch as th
from hypothesis import settings

# Small networks: more threads would only fight over the cores
th.set_num_threads(1)

# No deadline and no database: slow machines and read-only checkouts run the same tests
settings.register_profile("sb3_gae", deadline=None, database=None, print_blob=True, max_examples=40)
settings.load_profile("sb3_gae")
