"""The house in order: layers, imports, forbidden constructs, sizes, packaging."""

import ast
import json
import os
import pickle
import re
import socket
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections import Counter
from pathlib import Path
from urllib.parse import urlsplit

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from house_rules import (
    LAYERS,
    imported_modules,
    may_import,
    room_of,
    violations,
)

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "sim2gp"
MODULES = sorted(PACKAGE.rglob("*.py"))
#: Code that users run; tests may break the rules they test.
RUNNABLE = [
    path
    for folder in ("src", "examples", "benchmarks", "docs")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
#: "path: rule", looked at and allowed once each, with the reason in the code.
AUDITED: tuple[str, ...] = (
    "src/sim2gp/cli/interrupts.py: os._exit()",
    "examples/from_python.py: top-level import of mujoco",
)


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT / "src").with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer_faults(path: Path) -> list[str]:
    """Imports of one module that point up, sideways, or through the front door."""
    importer = room_of(module_name(path))
    if importer in ("", "__main__"):  # the table of contents sees everything
        return []
    tree = ast.parse(path.read_text(), relative(path))
    faults = []
    for name in imported_modules(tree, module_name(path), path.name == "__init__.py"):
        if not (name == "sim2gp" or name.startswith("sim2gp.")):
            continue
        imported = room_of(name)
        if imported == "__version__":
            continue
        rooms = frozenset().union(*LAYERS)
        if imported not in rooms:
            faults.append(f"{relative(path)}: {name} is not a room; import from one")
        elif not may_import(importer, imported):
            faults.append(f"{relative(path)}: {importer} must not see {imported}")
    return faults


def test_imports_point_down() -> None:
    faults = [fault for path in MODULES for fault in layer_faults(path)]
    assert not faults, "\n".join(faults)


def test_every_room_has_a_layer() -> None:
    placed = frozenset().union(*LAYERS) | {"", "__main__"}
    unplaced = {room_of(module_name(path)) for path in MODULES} - placed
    assert not unplaced, "place these in LAYERS of tests/house_rules.py"


@pytest.mark.parametrize(
    ("importer", "imported", "allowed"),
    [
        ("models", "identification", False),
        ("systems", "data", False),
        ("errors", "inference", False),
        ("planning", "belief", True),
        ("cli", "reports", True),
        ("reports", "cli", False),
        ("inference", "systems", False),
        ("models", "models", True),
    ],
)
def test_layer_rule_bites(importer: str, imported: str, allowed: bool) -> None:
    assert may_import(importer, imported) is allowed


def test_relative_and_late_imports_are_seen() -> None:
    source = (
        "def f():\n    from ..models import base\n    import sim2gp.planning.loop\n"
    )
    seen = set(imported_modules(ast.parse(source), "sim2gp.planning.mpc", False))
    assert seen == {"sim2gp.models.base", "sim2gp.planning.loop"}


def test_no_forbidden_construct() -> None:
    faults = {
        f"{relative(path)}:{fault}": f"{relative(path)}: {fault.split(': ', 1)[1]}"
        for path in RUNNABLE
        for fault in violations(path.read_text(), relative(path))
    }
    left = Counter(faults.values()) - Counter(AUDITED)
    assert not left, "\n".join(line for line, rule in faults.items() if rule in left)
    assert not Counter(AUDITED) - Counter(faults.values())  # none is out of date


def test_temporary_files_are_made_in_one_place() -> None:
    """There they are registered, to go with a process that has to end at once."""
    makers = [
        relative(path)
        for path in MODULES
        if "tempfile" in imported_modules(ast.parse(path.read_text()), "", False)
    ]
    assert makers == ["src/sim2gp/cleanup.py"]


@pytest.mark.parametrize(
    ("source", "rule"),
    [
        ("y = jnp.nan_to_num(x)", "nan_to_num"),
        ("from numpy import nan_to_num", "nan_to_num"),
        ("y = jnp.where(jnp.isnan(x), 0.0, x)", "where(isnan)"),
        ("y = np.where(~np.isnan(x), x, 0.0)", "where(isnan)"),
        ("try:\n    f()\nexcept Exception:\n    pass", "swallowed Exception"),
        (
            "for i in x:\n try:\n  f()\n except (ValueError, Exception):\n  continue",
            "swallowed Exception",
        ),
        ("try:\n    f()\nexcept:\n    raise", "bare except"),
        ("exit(1)", "exit()"),
        ("import sys\nsys.exit(1)", "exit()"),
        ("os._exit(1)", "os._exit()"),
        ("A = jnp.linalg.inv(B)", "explicit inverse"),
        ("A = np.linalg.inv(B)", "explicit inverse"),
        ("from scipy.linalg import inv", "explicit inverse"),
        ("import pickle", "import of pickle"),
        ("from pickle import loads", "import of pickle.loads"),
        ("def f():\n    import yaml", "import of yaml"),
        ("from urllib import request", "import of urllib.request"),
        ("eval('1')", "eval()"),
        ("exec(code)", "exec()"),
        ("os.system('ls')", "os.system()"),
        ("subprocess.run('ls', shell=True)", "shell=True"),
        ("np.load(f, allow_pickle=True)", "allow_pickle=True"),
        ("jax.config.update('jax_enable_x64', True)", "global float64"),
        ("def f(x, *, key=jax.random.key(0)): ...", "defaulted key"),
        ("import matplotlib.pyplot as plt", "top-level import of matplotlib.pyplot"),
        ("try:\n    import mujoco\nfinally:\n    f()", "top-level import of mujoco"),
    ],
)
def test_each_rule_bites(source: str, rule: str) -> None:
    assert rule in [fault.split(": ", 1)[1] for fault in violations(source)]


@pytest.mark.parametrize(
    "source",
    [
        "ranked = jnp.where(jnp.isfinite(r), r, -jnp.inf)",
        "if np.isnan(x).any():\n    raise ValueError('NaN')",
        "try:\n    f()\nexcept OSError:\n    pass",
        "try:\n    f()\nexcept Exception as error:\n    raise InputError() from error",
        "raise SystemExit(main())",
        "x = model.eval(y) + jnp.linalg.solve(A, b)",
        "np.load(f, allow_pickle=False)",
        "def f(x, *, key: Key): ...",
        "def f(table: dict, key: str = ''): ...",
        "def plot():\n    import matplotlib.pyplot as plt",
        "if TYPE_CHECKING:\n    import mujoco",
    ],
)
def test_innocent_code_passes(source: str) -> None:
    assert violations(source) == []


@pytest.mark.parametrize("path", [p for p in RUNNABLE if p.parent.name == "benchmarks"])
def test_a_benchmark_gives_each_name_one_value(path: Path) -> None:
    """No type checker reads these: the second value would silently be the only one."""
    found = Counter(
        name.id
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign)
        for target in node.targets
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    )
    assert [name for name, count in found.items() if count > 1] == []


def test_files_and_functions_stay_small() -> None:
    long = []
    for path in RUNNABLE + TESTS:
        source = path.read_text()
        lines = len(source.splitlines())
        if lines > 400:
            long.append(f"{relative(path)}: {lines} lines")
        for node in ast.walk(ast.parse(source, relative(path))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > 60:
                    long.append(f"{relative(path)}: {node.name} has {lines} lines")
    assert not long, "two ideas share one room:\n" + "\n".join(long)


def run_python(code: str) -> str:
    """A fresh interpreter, as a user starts one; returns what it printed."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        cwd="/",
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


IMPORT_PROBE = """
import json, sys, time
import equinox, jax, jax.monitoring, scipy.linalg
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **_: compiled.append(name) if "compile" in name else None)
before, start = set(sys.modules), time.process_time()
import sim2gp
seconds = time.process_time() - start
print(json.dumps({
    "seconds": seconds,
    "compiled": compiled,
    "modules": sorted({name.split(".")[0] for name in sys.modules}),
    "x64": bool(jax.config.jax_enable_x64),
}))
"""


def test_import_is_light() -> None:
    """No heavy module, nothing compiled, float64 left alone."""
    probe = json.loads(run_python(IMPORT_PROBE))
    heavy = {"matplotlib", "mujoco", "gymnasium", "pandas", "torch", "IPython", "lxml"}
    assert not heavy & set(probe["modules"])
    assert probe["compiled"] == []
    assert probe["x64"] is False
    # Processor seconds above the dependencies' own; a thousandth is typical.
    assert probe["seconds"] < 5.0


@pytest.mark.parametrize("name", ["data.logs", "project.project", "runs"])
def test_what_answers_first_loads_no_simulator(name: str) -> None:
    """A log that is refused, a project that is: neither waits a second for JAX."""
    run_python(f"import sys, sim2gp.{name}\nassert 'jax' not in sys.modules")


def test_lapack_is_loaded_after_its_threads_are_set() -> None:
    """SciPy's library reads the variable once, and `main` sets it after the imports."""
    run_python("import sys, sim2gp.cli\nassert 'scipy.linalg' not in sys.modules")


def test_every_module_imports_without_extras() -> None:
    """An extra that is not installed breaks its own feature, never an import."""
    names = [module_name(path) for path in MODULES if path.stem != "__main__"]
    extras = ["mujoco", "gymnasium", "h5py", "pyarrow", "beartype", "hypothesis"]
    extras += ["tensorboardX", "wandb", "lxml"]
    block = f"import sys\nfor name in {extras}: sys.modules[name] = None\n"
    run_python(block + "".join(f"import {name}\n" for name in names))


def build(target: str, folder: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target]
    subprocess.run([*command, "-d", str(folder)], cwd=ROOT, check=True)
    (archive,) = folder.iterdir()
    return archive


def test_sdist_holds_the_sources_and_little_else(tmp_path: Path) -> None:
    archive = build("sdist", tmp_path)
    assert archive.stat().st_size < 2_000_000
    with tarfile.open(archive) as tar:
        names = {name.split("/", 1)[1] for name in tar.getnames()}
    assert {"src/sim2gp/__init__.py", "LICENSE", "constraints.txt"} <= names
    tops = {name.split("/")[0] for name in names}
    assert tops <= {
        *("src", "tests", "docs", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"),
        *("LICENSE", "Makefile", "README.md", "SECURITY.md", "constraints.txt"),
        *("pyproject.toml", "zensical.toml", "PKG-INFO", ".gitignore"),
    }
    assert not [name for name in names if "__pycache__" in name]


def test_wheel_is_the_package(tmp_path: Path) -> None:
    with zipfile.ZipFile(build("wheel", tmp_path)) as wheel:
        names = set(wheel.namelist())
    assert "sim2gp/py.typed" in names
    assert all(re.match(r"sim2gp(-[^/]+\.dist-info)?/", name) for name in names)
    assert {f"sim2gp/{p.relative_to(PACKAGE).as_posix()}" for p in MODULES} <= names


def test_shapes_are_checked_under_pytest() -> None:
    """The import hook of pyproject.toml is at work; users do not pay for it."""
    from sim2gp.inference.gaussian import Gaussian

    with pytest.raises(TypeCheckError):
        Gaussian(jnp.zeros(2), jnp.zeros((3, 3)))
    code = "import jax.numpy as jnp; from sim2gp.inference.gaussian import Gaussian; "
    run_python(code + "Gaussian(jnp.zeros(2), jnp.zeros((3, 3)))")


def test_unpickling_shells_and_network_are_refused() -> None:
    """The audit hook of conftest.py stands guard over the whole suite."""
    with pytest.raises(RuntimeError, match=r"pickle\.find_class"):
        pickle.loads(b"cbuiltins\nlist\n.")
    with pytest.raises(RuntimeError, match=r"os\.system"):
        os.system("true")
    with pytest.raises(RuntimeError, match=r"socket\.getaddrinfo"):
        socket.getaddrinfo("localhost", 80)


def tracked_files() -> list[Path]:
    command = ["git", "-C", str(ROOT), "ls-files", "-z"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip("not a git checkout: nothing is tracked")
    return [
        p for name in done.stdout.split("\0") if name and (p := ROOT / name).is_file()
    ]


def test_tracked_files_name_no_host_and_no_machine() -> None:
    """No package index, no path of the machine that built it (characters in brackets
    keep this file from naming what it forbids)."""
    patterns = [r"py[p]i\.org", r"python[h]osted", r"index-[u]rl", r"find-[l]inks"]
    patterns += [r"/ro[o]t/", r"/ho[m]e/\w+/", r"/Use[r]s/\w+/", r"site-packa[g]es/"]
    patterns += [re.escape(f"{folder}/") for folder in (ROOT, Path.home())]
    for name in ("PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL", "UV_DEFAULT_INDEX"):
        host = urlsplit(os.environ.get(name, "")).hostname
        patterns += [re.escape(host)] if host else []
    forbidden = re.compile("|".join(patterns))
    found = []
    for path in tracked_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # a picture
        for number, line in enumerate(text.splitlines(), 1):
            if forbidden.search(line):
                found.append(f"{relative(path)}:{number}")
    assert not found, "\n".join(found)


def test_nothing_large_is_tracked() -> None:
    large = [relative(p) for p in tracked_files() if p.stat().st_size > 2_000_000]
    assert not large


def test_constraints_pin_every_requirement() -> None:
    """`make` installs what constraints.txt says; what it forgot would float."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"]]
    for extra in project["optional-dependencies"].values():
        wanted += extra
    names = {re.split(r"[\[><=;!~ ]", line)[0].lower() for line in wanted} - {"sim2gp"}
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert all(re.match(r"[a-z0-9._-]+==[0-9][^ ]*( ; .+)?$", line) for line in lines)
    pinned = {line.split("==")[0] for line in lines}
    assert names <= {*pinned}
    assert "sim2gp" not in pinned
