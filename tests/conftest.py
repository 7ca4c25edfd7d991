"""What every test runs under: strict promotion, fresh keys, repeatable examples.

float64 is switched on for no test that does not ask for it: the library scopes it, and
tests must see what a user sees. Shapes and types are checked by jaxtyping and beartype
(pyproject.toml).
"""

import ctypes
import gc
import itertools
import multiprocessing.queues
import os
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import jax
import pytest

ROOT = Path(__file__).resolve().parents[1]

# Tracing makes many small objects that live on: collecting them as often as Python does
# by default costs 8 % of the time.
gc.set_threshold(20_000, 20, 100)

# As the command line (`sim2gp.cli.main`): threads that wait where cores are busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

#: What no test, and nothing that a test calls, may do: load pickled objects, start a
#: shell, look up or reach a host (reliability: data never run code, no network).
FORBIDDEN_EVENTS = frozenset(
    {"pickle.find_class", "os.system", "socket.getaddrinfo", "socket.connect"}
)


#: Who reads what our own processes send: no data from outside.
OF_WORKERS = (
    multiprocessing.queues.__file__,
    os.path.join("_private", "serialization.py"),
)


def from_a_worker() -> bool:
    """Whether a result of one of our own processes is being read, Ray's included."""
    return sys._getframe(2).f_code.co_filename.endswith(OF_WORKERS)


def refuse(event: str, args: tuple[object, ...]) -> None:
    """An audit hook of the interpreter: raising stops the operation."""
    if event == "pickle.find_class" and from_a_worker():
        return
    if event in FORBIDDEN_EVENTS:
        raise RuntimeError(f"forbidden while testing: {event} {args!r:.200}")


sys.addaudithook(refuse)

# A compile inside an example is slow once; a flaky example is slow for ever.
hypothesis.settings.register_profile("unit", deadline=None, derandomize=True)
hypothesis.settings.register_profile("nightly", deadline=None, max_examples=2000)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "unit"))


#: Resident bytes above which a file of tests leaves no compiled code to the next one.
#: A program of one operation keeps 1.4 MB, a file of tests at most 1.3 GB. All of them
#: in two processes: at most 1.8 GiB in each.
MUCH = 1000 * 2**20
#: Linux: pages of this process, in all and resident.
PAGES = Path("/proc/self/statm")


#: Files of few and long tests: at the end of a run they leave one process alone.
LONG = ("windows", "compare", "design_run")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files of long tests first (with xdist's own order off)."""
    first = {f"test_{name}" for name in LONG}
    items.sort(key=lambda item: item.path.stem not in first)


@pytest.fixture(scope="module", autouse=True)
def bounded_memory() -> Iterator[None]:
    """Forget compiled code between files, once there is much of it."""
    yield
    if PAGES.exists():
        resident = int(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if resident > MUCH:
            jax.clear_caches()
            gc.collect()
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture
def getkey(request: pytest.FixtureRequest) -> Callable[[], jax.Array]:
    """A function that returns a new key at each call: (the test's name, a counter)."""
    root = jax.random.key(zlib.crc32(request.node.nodeid.encode()))
    counter = itertools.count()
    return lambda: jax.random.fold_in(root, next(counter))


@pytest.fixture
def float64() -> Iterator[None]:
    """For tests of mathematics below the library's own scope."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def lenient_promotion() -> Iterator[None]:
    """For code of others that mixes ranks and dtypes inside: MJX."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings beside the checkout; skips where there is none."""
    folder = Path(os.environ.get("SIM2GP_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(
            f"no recordings at {folder} (the project ships none; set SIM2GP_DATA to "
            "the folder that holds double_pendulum/ and qube/)"
        )
    return folder


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """Grows by one entry for each program that XLA compiles."""
    seen: list[str] = []

    def listen(event: str, duration: float, **about: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)
