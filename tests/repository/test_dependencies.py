"""What is installed is what is imported: no more, no less."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from house_rules import top_level_imports
from sim2gp.errors import catalogue
from simulated_logs import simulated
from tests.commands.test_identify import project_in, write
from tests.repository.test_house import MODULES, ROOT, build, relative

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: Extras that no code of the package imports: tools, and libraries to compare with.
TOOLS = {"test", "docs", "dev", "bench"}
#: `jax.export` imports it, when a policy is compiled.
THROUGH_OTHERS = {"flatbuffers"}
#: Functions whose first argument is a module that they import, when a file needs it.
IMPORTERS = {"import_module", "import_optional"}


def distribution(requirement: str) -> str:
    """The name of what is required, as installers compare names."""
    name = re.split(r"[\[<>=!~; ]", requirement)[0]
    return re.sub(r"[-_.]+", "-", name).lower()


def declared(extras: bool) -> set[str]:
    """Names of the core's dependencies, or of those of all extras that are imported."""
    if not extras:
        return set(map(distribution, PROJECT["dependencies"]))
    wanted = PROJECT["optional-dependencies"].items()
    found = {
        distribution(r) for name, many in wanted if name not in TOOLS for r in many
    }
    return found - {"sim2gp"}


def imported(path: Path) -> set[str]:
    """Every module that a file imports, at its top or later, of other projects."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(str(node.module))
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, "id", getattr(node.func, "attr", ""))
            first = node.args[0]
            if called in IMPORTERS and isinstance(first, ast.Constant):
                names.add(str(first.value))
    return {name for name in names if not is_known(name)}


def is_known(module: str) -> bool:
    top = module.split(".")[0]
    return top in sys.stdlib_module_names or top == "sim2gp"


#: There wherever the code that imports it runs: a notebook's own kernel.
HOSTS = {"IPython"}
#: What is installed that holds each module; seconds to collect.
installed = cache(packages_distributions)


def providers(module: str) -> set[str]:
    """What is installed and holds a module, or else what is named like it."""
    top = module.split(".")[0]
    return set(map(distribution, installed().get(top, [top])))


def test_what_is_imported_is_declared() -> None:
    """At the top of a module by the core; later by the core or by an extra."""
    core, extra = declared(False), declared(True)
    faults = []
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        first = {name for _, name in top_level_imports(tree) if not is_known(name)}
        for module in imported(path):
            if module.split(".")[0] in HOSTS and module not in first:
                continue
            allowed = core if module in first else core | extra
            if not providers(module) & allowed:
                faults.append(f"{relative(path)}: {module}")
    assert not faults, "declare what provides these:\n" + "\n".join(sorted(faults))


def test_what_is_declared_is_imported() -> None:
    modules = {module for path in MODULES for module in imported(path)}
    found = {name for module in modules for name in providers(module)}
    unused = (declared(False) | declared(True)) - found - THROUGH_OTHERS
    assert not unused, f"nothing imports {sorted(unused)}"


def test_every_extra_is_named_by_the_error_without_it() -> None:
    """Whoever lacks an extra reads which one: E135 with its name."""
    words = {entry.fix for entry in catalogue().values() if entry.code == "E135"}
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        if "missing_extra" in text or "E135" in text or "import_optional(" in text:
            words |= {
                str(node.value)
                for node in ast.walk(ast.parse(text))
                if isinstance(node, ast.Constant)
            }
    extras = set(PROJECT["optional-dependencies"]) - TOOLS - {"io"}
    assert all(any(name in re.split(r"[\[\]' ,]", w) for w in words) for name in extras)


@pytest.mark.nightly
def test_the_wheel_alone_runs_demo_identify_and_report(tmp_path: Path) -> None:
    """A new environment that holds the wheel and its dependencies, and no more."""
    (tmp_path / "dist").mkdir()
    wheel = build("wheel", tmp_path / "dist")
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "env")], check=True)
    scripts = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin")
    python = shutil.which("python", path=str(scripts))
    assert python is not None
    constraints = str(ROOT / "constraints.txt")
    done = subprocess.run(
        [python, "-m", "pip", "install", "-q", "-c", constraints, str(wheel)],
        capture_output=True,
        text=True,
    )
    if done.returncode != 0 and "No matching distribution" in done.stderr:
        pytest.skip("no package index: " + done.stderr.strip().splitlines()[-1])
    assert done.returncode == 0, done.stderr
    for seed in (1, 2):
        log = simulated(seconds=1.3, seed=seed, noise=5e-4)
        write(log, tmp_path / "logs" / f"{seed}.csv")
    project_in(tmp_path)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = shutil.which("sim2gp", path=str(scripts))
    assert command is not None
    for words in (
        ["demo", "--episodes", "1"],
        ["identify", "machine.toml", "--quick"],
        ["report", "runs/machine"],
        ["report", "runs/demo"],
    ):
        done = subprocess.run(
            [command, *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{words}: {done.stderr}"
    for name in ("machine", "demo"):
        assert (tmp_path / "runs" / name / "report.html").stat().st_size > 10_000
