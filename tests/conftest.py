"""What several modules of tests share. Fixtures that take seconds are made once in a session;
whoever gets one leaves it as it is.

Helper modules stand beside this file: `synthetic_photo` (an analytic photographer),
`forward_scenes` (lights and materials of the forward model), `chromium` (a browser).
"""

import os
import shutil
from functools import cache

# Workers share the processors. OpenMP's threads wait for each other by spinning: where there are
# more of them than processors, torch's convolutions take ten times as long and more. Before torch
# and numpy are loaded; processes that tests start inherit it.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    own = max(1, (os.cpu_count() or 1) // int(workers))
    os.environ.setdefault("OMP_NUM_THREADS", str(own))

import pytest

from invrender.cli.main import main
from invrender.data import EXAMPLE


@pytest.fixture
def capture(tmp_path):
    """A copy of the bundled capture's folder, to be changed at will."""
    return shutil.copytree(EXAMPLE, tmp_path / "capture")


@pytest.fixture(scope="session")
def example_result(tmp_path_factory):
    """A function of "network" or "flat", where refinement starts: the folder of results of the
    bundled capture at 32 pixels a side."""

    @cache
    def refine(init):
        out = tmp_path_factory.mktemp("example") / init
        command = ["refine", "example", "-o", str(out), "--size", "32", "--init", init, "-q"]
        assert main(command) == 0
        return out

    return refine
