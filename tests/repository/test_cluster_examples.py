"""The scripts of the page on clusters, run here at small size."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from sim2gp.runs import load_run

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "cluster"
FIGURE = ("fig1", "--quick", "--seeds", "4")


def run(*words: str, **more: str) -> str:
    """What a command prints, with variables of the environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        words,
        env=os.environ | {"PATH": path, "NPROC": "1"} | more,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def same(one: Path, other: Path) -> None:
    arrays, others = load_run(one).arrays, load_run(other).arrays
    assert arrays.keys() == others.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(others[name], values, err_msg=name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The figure by one process on one core."""
    out = tmp_path_factory.mktemp("whole") / "fig1"
    run("sim2gp", "reproduce", *FIGURE, "--workers", "1", "--out", str(out))
    return out


@pytest.mark.nightly
def test_tasks_of_a_job_array_make_the_figure(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "fig1"
    script = "bash", str(EXAMPLES / "job_array.sh"), *FIGURE, "--out", str(out)
    for task in ("2", "1"):
        array = {"SLURM_ARRAY_TASK_ID": task, "SLURM_ARRAY_TASK_COUNT": "2"}
        assert f"share {task} of 2" in run(*script, **array)
        assert not out.exists()
    run(*script)
    same(out, whole)


@pytest.mark.nightly
def test_two_nodes_of_ray_make_the_figure(whole: Path, tmp_path: Path) -> None:
    """Both on this machine, started as the page says."""
    pytest.importorskip("ray")
    address = "127.0.0.1:6399"
    quiet = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}
    node = "--num-cpus=1", "--include-dashboard=false"
    try:
        run("ray", "start", "--head", "--port=6399", *node, **quiet)
        run("ray", "start", f"--address={address}", node[0], **quiet)
        out = str(tmp_path / "fig1")
        words = "sim2gp", "reproduce", *FIGURE, "--ray", address, "--out", out
        run(*words, **quiet)
    finally:
        run("ray", "stop", "--force")
    same(tmp_path / "fig1", whole)


def test_the_cluster_file_is_one_of_rays() -> None:
    """By Ray's own schema; and its commands install what this is."""
    util = pytest.importorskip("ray.autoscaler._private.util")
    config = yaml.safe_load((EXAMPLES / "ray_cluster.yaml").read_text())
    util.validate_config(util.prepare_config(config))
    version = (ROOT / "src" / "sim2gp" / "__init__.py").read_text()
    (command,) = config["setup_commands"]
    assert command.split("==")[1].rstrip("'") in version
