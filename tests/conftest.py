"""Shared fixtures. Importing emulator turns on float64 before any test touches JAX.

Compiled programs are kept in a folder that all workers, and the processes that tests start, share:
compilation is most of the time, and most programs are wanted by several of them.
"""

import gc
import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Read by JAX when it is imported, here and in the processes that tests start.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Read by BLAS when it is loaded. Two workers whose small matrices have a thread a core each wait for
# each other: the fit of a correction took 30 times the processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest

import calibrate.project.calibration  # noqa: F401 - with all it imports, before warnings are errors
import emulator as em
from emulator.scenes import Scene

SHARED = ROOT.parent / "shared"
PUBLISHED, MEASURED = SHARED / "published", SHARED / "measured"
CASES = SHARED / "cases"


# A compiled program takes some ten memory maps. Linux allows a process 65 530; beyond, XLA crashes.
MAPS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")
MOST_MAPS = 30_000
MOST_BYTES = 4e9  # in memory, of a process that is one of two


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Drop compiled programs after a module that leaves the process with too much memory."""
    yield
    if not MAPS.exists():
        return
    resident = int(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if resident > MOST_BYTES or MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def published() -> Path:
    """Folder of the released data; the test is skipped where it is absent."""
    if not PUBLISHED.is_dir():
        pytest.skip(f"the released data is not at {PUBLISHED.parent.name}/{PUBLISHED.name}")
    return PUBLISHED


@pytest.fixture(scope="session")
def measured() -> Path:
    """Folder of measurements of real bodies; the test is skipped where it is absent."""
    if not MEASURED.is_dir():
        pytest.skip(f"no measurements at {MEASURED.parent.name}/{MEASURED.name}")
    return MEASURED


@pytest.fixture(scope="session")
def cases() -> Path:
    """Folder of inputs as users bring them; the test is skipped where it is absent."""
    if not CASES.is_dir():
        pytest.skip(f"no inputs of users at {CASES.parent.name}/{CASES.name}")
    return CASES


@pytest.fixture(scope="session")
def beam() -> Scene:
    """A coarse once-clamped beam: 45 nodes, 96 tetrahedra."""
    return em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)


@pytest.fixture(scope="session")
def cube() -> Scene:
    """A coarse twisting cube."""
    return em.scenes.twisting_cube(cells=3, order=1)


@pytest.fixture(scope="session")
def ventricle() -> Scene:
    """A coarse left ventricle: one layer."""
    return em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1)


@pytest.fixture(scope="session")
def simulator(beam: Scene) -> em.Simulator:
    return em.Simulator(beam)


@pytest.fixture
def strict():
    """JAX as strict as it can be: no silent promotion of rank or dtype."""
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield
