"""Where loops cannot be compiled, filters run all the same, and one line on stderr says what it costs."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
import torch

from dlkf.navigation import compiled

RUN = """
import torch
from dlkf.navigation import compiled
from dlkf.navigation.attitude import rotation_from_vector

phi = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
with_gradient = rotation_from_vector(phi)  # asks for nothing compiled
with torch.no_grad():
    assert all(torch.allclose(rotation_from_vector(phi), with_gradient, rtol=0, atol=1e-14) for _ in range(3))
print(compiled.AVAILABLE)
"""
WORLDS = {  # what is wrong before dlkf is loaded, whether loops are compiled then, what is said
    "no numba": ("import sys; sys.modules['numba'] = None", "False", "numba cannot be loaded .*, so filters run up to"),
    "nowhere to keep it": (
        "from numba.core.caching import CacheImpl; CacheImpl._locator_classes = []",
        "True",
        "every process compiles the loops again.*NUMBA_CACHE_DIR",
    ),
}


@pytest.mark.parametrize("world", ["no numba", pytest.param("nowhere to keep it", marks=pytest.mark.commands)])
@pytest.mark.whole
def test_what_is_wrong_is_said_once(world):
    before, available, said = WORLDS[world]
    done = subprocess.run([sys.executable, "-c", before + RUN], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [available]
    (line,) = done.stderr.splitlines()
    assert line.startswith("dlkf: warning: ") and re.search(said, line)


@pytest.mark.skipif(not compiled.AVAILABLE or compiled.TROUBLE != "", reason="loops cannot be compiled here")
def test_nothing_is_said_where_all_is_well(capfd):
    with torch.no_grad():
        assert compiled.fits(torch.zeros(1))
    assert capfd.readouterr() == ("", "")


def test_short_work_can_do_without():
    with torch.no_grad(), compiled.without_loops():
        assert not compiled.fits(torch.zeros(1))


@pytest.mark.commands
@pytest.mark.whole
def test_numba_loads_with_the_first_loop():
    """It takes half a second, which a command that needs no loop saves."""
    load = "import sys, dlkf.navigate; assert 'numba' not in sys.modules\n"
    done = subprocess.run([sys.executable, "-c", load + RUN + "assert 'numba' in sys.modules"], capture_output=True)
    assert done.returncode == 0, done.stderr
