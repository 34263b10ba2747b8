"""Episodes from real systems: public flights and the logs of a Crazyflie."""

from trajlearn.datasets._fetch import get_data_home
from trajlearn.datasets.alignment import ReferenceAlignment, align_references
from trajlearn.datasets.crazyflie import load_crazyflie_gains
from trajlearn.datasets.nanobench import load_nanobench_trefoil
from trajlearn.datasets.usd import UsdEvents, read_usd_log

__all__ = [
    "ReferenceAlignment",
    "UsdEvents",
    "align_references",
    "get_data_home",
    "load_crazyflie_gains",
    "load_nanobench_trefoil",
    "read_usd_log",
]
