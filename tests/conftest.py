"""What all tests share: those on several ranks, and how many workers share the files."""

from __future__ import annotations

import os

import pytest

pytest_plugins = ["several_ranks"]
MOST_WORKERS = 8  # files go to workers whole, and there is no more work than that


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """`-n auto` of pytest-xdist: a worker for each core that this process may use."""
    return min(len(os.sched_getaffinity(0)), MOST_WORKERS)
