"""What holds for every test: one thread, no window, reproducible random examples."""

import os

import pytest
from hypothesis import HealthCheck, settings

# In time: numpy and torch, which read these once, are imported by the tests only.
for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# scipy reads this once too: scikit-learn's check of array API input then runs instead of skipping.
os.environ.setdefault("SCIPY_ARRAY_API", "1")

# Examples that train a model are slow by nature: few of them, and no deadline on any.
settings.register_profile(
    "local", deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> None:
    import torch

    torch.set_num_threads(1)
