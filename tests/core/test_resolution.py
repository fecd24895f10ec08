"""Installed beside the packages that robot learning uses: the versions can be resolved together."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIMIT = 300.0
"""Time for one resolution [s]; some 10 s with an empty cache."""
# What uv says if it cannot reach the registry. Only then a test may be skipped.
_OFFLINE = (
    "error: Failed to fetch",
    "cause: Failed to fetch",
    "the network was disabled",
)
# Whatever robot learning uses beside a hand, not older than these.
COMPANY = (
    "dex-retargeting>=0.5",
    "gymnasium-robotics>=1.4",
    "isaacteleop>=1.5",
    "mani-skill>=3.0.1",
    "mink>=1.3",
)
# lerobot 0.5 and later require numpy < 2.3, isaaclab 3.0 pins daqp 0.8.5. Both are for Python 3.12.
NEIGHBOURS = {
    "newest": (
        *COMPANY,
        "jax>=0.12",
        "mujoco>=4",
        "pin-pink>=4.4",
        "rerun-sdk>=0.41",
        "torch>=2.15",
    ),
    # isaaclab 3.0 pins pin-pink 3.3.0, and its torch and MuJoCo are older ones.
    "all at once": (
        *COMPANY,
        "lerobot>=0.6",
        "isaaclab>=3",
        "jax",
        "mujoco",
        "pin-pink",
        "rerun-sdk",
        "torch",
    ),
    # By the metadata of isaaclab 3.0.0 on PyPI, should a later one have others.
    "pins": (
        "numpy>=2,<2.3",
        "daqp==0.8.5",
        "pin-pink==3.3.0",
        "h5py>=3.15.0",
        "trimesh>=4.6.8",
    ),
}

# uv asks the registry for hundreds of packages, so `make full` runs the whole module.
pytestmark = [pytest.mark.slow, pytest.mark.full]


def resolved(
    folder: Path, requirements: tuple[str, ...]
) -> subprocess.CompletedProcess[str]:
    """Let uv resolve the package with all extras, beside other requirements."""
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        pytest.skip("uv is not installed")
    beside = folder / "beside.in"
    beside.write_text("\n".join(requirements), encoding="utf-8")
    # Versions of packages are of interest, not an interpreter of that version.
    words = (uv, "pip", "compile", "--no-python-downloads", "--python-version", "3.12")
    try:
        done = subprocess.run(
            (*words, "--extra", "all", "pyproject.toml", str(beside)),
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
    except subprocess.TimeoutExpired:
        pytest.skip(f"the registry did not answer within {LIMIT:g} s")
    if done.returncode and any(sign in done.stderr for sign in _OFFLINE):
        pytest.skip(
            f"the registry cannot be reached: {done.stderr.strip().splitlines()[-1]}"
        )
    return done


@pytest.mark.parametrize("name", NEIGHBOURS)
def test_it_can_be_installed_beside_its_neighbours(name: str, tmp_path: Path) -> None:
    done = resolved(tmp_path, NEIGHBOURS[name])
    assert done.returncode == 0, done.stderr


def test_versions_that_exclude_each_other_are_noticed(tmp_path: Path) -> None:
    # isaacsim 5.1 and ROS Jazzy bring numpy 1.26: there, only the client can be installed.
    done = resolved(tmp_path, ("numpy<2",))
    assert done.returncode == 1
    assert "numpy" in done.stderr
