"""Workers have one thread each, and leave the settings as they were."""

import threading

import pytest
import torch
from joblib import parallel_config

from trajlearn.regressors._threads import by_workers


def threads(job):
    return job, torch.get_num_threads()


@pytest.fixture
def several():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_one_worker_keeps_its_threads(several):
    assert list(by_workers(threads, [(1,), (2,)], None)) == [(1, 2), (2, 2)]


def test_several_have_one_each(several):
    # processes would take long to start
    with parallel_config("threading"):
        assert list(by_workers(threads, [(k,) for k in range(4)], 2)) == [(k, 1) for k in range(4)]
    assert torch.get_num_threads() == 2


def test_results_come_in_order_as_they_are_ready(several):
    done = []

    def work(k):
        done.append(k)
        return k, threading.get_ident()

    results = by_workers(work, [(0,), (1,)], None)
    assert next(results)[0] == 0
    assert done == [0]
