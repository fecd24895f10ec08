"""Files that only other machines run: workflows, recipes, the image, the manifest of ROS.

They are parsed here and compared with what they must agree with. The addresses of the repository
are written into copies of all packages, whose metadata is then read by their build backends.
"""

from __future__ import annotations

import io
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tomllib
import xml.etree.ElementTree as ET
import zipfile
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml

import handmap_qp

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = sorted(file.parent for file in (ROOT / "packages").glob("*/pyproject.toml"))
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PYPI = "pypa/gh-action-pypi-publish@release/v1"
REPOSITORY = "https://host/owner/name"
# Names of distributions that conda-forge has by another name.
CONDA_NAMES = {"pin": "pinocchio"}
# The platforms of each machine of the workflow, as the support matrix has them.
MACHINES = {
    "ubuntu-latest": "Linux x86-64",
    "ubuntu-24.04-arm": "Linux aarch64",
    "macos-15": "macOS arm64",
}
SYSTEMS = {"POSIX :: Linux": "Linux", "MacOS": "macOS"}


def read(name: str) -> str:
    """Return the text of a file of the tree."""
    return (ROOT / name).read_text("utf-8")


@cache
def parsed(name: str) -> dict[Any, Any]:
    """Return a YAML file of the tree; the key `on` of a workflow is True in YAML 1.1."""
    return yaml.safe_load(read(name))


@cache
def project(folder: str = "") -> dict[str, Any]:
    """Return the table `project` of a pyproject.toml."""
    return tomllib.loads(read(f"{folder}pyproject.toml"))["project"]


def jobs(name: str = "release") -> dict[str, Any]:
    """Return the jobs of a workflow."""
    return parsed(f".github/workflows/{name}.yml")["jobs"]


def steps_with(job: dict[str, Any], action: str) -> list[dict[str, Any]]:
    """Return the steps of a job that use an action."""
    return [step for step in job["steps"] if step.get("uses", "").startswith(action)]


def publishers() -> dict[str, Any]:
    """Return the jobs that upload to the package index."""
    return {name: job for name, job in jobs().items() if steps_with(job, PYPI)}


def before(name: str) -> set[str]:
    """Return all jobs that a job of the release waits for, also indirectly."""
    direct = {*jobs()[name].get("needs", [])}
    return direct.union(*map(before, direct))


def distribution(package: Path) -> str:
    """Return the name of a package's distribution, as its files have it."""
    text = (package / "pyproject.toml").read_text("utf-8")
    if "\n[project]\n" not in text:
        text = (package / "setup.py").read_text("utf-8")
    (name,) = re.findall(r'^(?:name|NAME) = "(.*)"$', text, re.MULTILINE)
    return name.replace("-", "_")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda file: file.stem)
def test_jobs_of_a_workflow_wait_for_jobs_that_exist(workflow: Path) -> None:
    content = yaml.safe_load(workflow.read_text("utf-8"))
    assert True in content
    assert content["permissions"] == {"contents": "read"}
    for job in content["jobs"].values():
        assert {*job.get("needs", [])} <= {*content["jobs"]}
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert "@" in step.get("uses", "@")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda file: file.stem)
def test_files_and_targets_that_workflows_name_exist(workflow: Path) -> None:
    text = workflow.read_text("utf-8")
    files = re.findall(r"(?<![\w/.])(?:\.ci|docs/deploy|conda)/[\w./-]*\w", text)
    assert files or "release" not in workflow.name
    for file in files:
        assert (ROOT / file).is_file(), file
    for target in re.findall(r"- run: make (\w+)|^ +make (\w+)", text, re.MULTILINE):
        assert f"\n{''.join(target)}:" in read("Makefile"), target


def test_each_project_of_the_index_trusts_an_environment_of_its_own() -> None:
    found: dict[str, str] = {}
    for job in publishers().values():
        (move,) = (step["run"] for step in job["steps"] if "run" in step)
        (name,) = re.findall(r"mv all/(.*)-\* dist$", move)
        rows = job.get("strategy", {}).get("matrix", {}).get("include", [{}])
        for row in rows:
            pair = name, job["environment"]
            for key, value in row.items():
                pair = tuple(
                    text.replace(f"${{{{ matrix.{key} }}}}", value) for text in pair
                )
            assert pair[0] not in found
            found[pair[0]] = pair[1]
    assert len({*found.values()}) == len(found)
    expected = {distribution(package): f"pypi-{package.name}" for package in PACKAGES}
    assert found == expected | {"handmap_core": "pypi-core", "handmap_qp": "pypi"}


def test_an_upload_can_be_repeated_and_has_the_token() -> None:
    assert len(publishers()) == 3
    for job in publishers().values():
        (step,) = steps_with(job, PYPI)
        assert step["with"]["skip-existing"] is True
        assert job["permissions"] == {"id-token": "write"}


def test_jobs_of_the_release_are_in_order() -> None:
    checked = {"build", "wheels", "check"}
    assert before("publish-core") == checked
    assert before("publish") == checked | {"publish-core"}
    assert before("publish-packages") == checked | {"publish-core", "publish"}
    assert {*publishers()} <= before("page")
    assert {"check", "publish"} <= before("site")


def test_a_dry_run_builds_everything_and_publishes_nothing() -> None:
    assert "workflow_dispatch" in parsed(".github/workflows/release.yml")[True]
    only = {name for name, job in jobs().items() if job.get("if")}
    for name in {*publishers(), "page"}:
        assert jobs()[name]["if"] == "github.event_name == 'push'"
    assert only == {*publishers(), "page", "site"}
    # The site is built without a publication, too, and pushed by a tag only.
    assert "!cancelled()" in jobs()["site"]["if"]
    assert "event_name == 'push' && '--push'" in jobs()["site"]["steps"][-1]["run"]
    (tag,) = (
        step
        for step in jobs()["build"]["steps"]
        if "GITHUB_REF_NAME" in step.get("run", "")
    )
    assert tag["if"] == "github.event_name == 'push'"


def test_no_job_of_a_tag_needs_the_environment_of_pages() -> None:
    for job in jobs().values():
        assert job.get("environment", "").partition("-")[0] in ("", "pypi")
        assert "pages" not in job.get("permissions", {})


def test_addresses_are_written_before_each_build_and_checked_after() -> None:
    for name, build in {
        "build": ".ci/wheel",
        "wheels": "pypa/cibuildwheel",
    }.items():
        lines = [step.get("run", step.get("uses")) for step in jobs()[name]["steps"]]
        (written,) = (i for i, line in enumerate(lines) if ".ci/addresses.py" in line)
        (built,) = (i for i, line in enumerate(lines) if line.startswith(build))
        assert lines[written] == "python .ci/addresses.py core"
        assert written < built
    assert "python .ci/addresses.py --check dist" in [
        step.get("run") for step in jobs()["check"]["steps"]
    ]
    assert 'addresses.py "$copies/$name"' in read(".ci/packages")


@pytest.mark.parametrize(
    "package",
    [ROOT / "core", *PACKAGES],
    ids=lambda package: package.name,
)
def test_metadata_of_each_package_has_the_addresses(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build = pytest.importorskip("build.util")
    copy = tmp_path / package.name
    shutil.copytree(
        package,
        copy,
        ignore=shutil.ignore_patterns("build", "*.so", "__pycache__", "src", "include"),
    )
    files = {file: file.read_bytes() for file in copy.rglob("*") if file.is_file()}
    script = str(ROOT / ".ci" / "addresses.py")
    monkeypatch.delenv("GITHUB_REPOSITORY", raising=False)
    subprocess.run([sys.executable, script, str(copy)], check=True)
    assert files == {file: file.read_bytes() for file in files}

    monkeypatch.setenv("GITHUB_SERVER_URL", "https://host")
    monkeypatch.setenv("GITHUB_REPOSITORY", "owner/name")
    for _ in range(2):
        subprocess.run([sys.executable, script, str(copy)], check=True)
    found = build.project_wheel_metadata(copy, isolated=False).get_all("Project-URL")
    assert {line.partition(", ")[2] for line in found} == {
        REPOSITORY,
        f"{REPOSITORY}/issues",
        f"{REPOSITORY}/blob/main/CHANGELOG.md",
    }


def test_files_without_an_address_are_found(tmp_path: Path) -> None:
    without_address = runpy.run_path(str(ROOT / ".ci" / "addresses.py"))[
        "without_address"
    ]
    head = "Metadata-Version: 2.4\nName: a\nVersion: 1\n"
    for name, text in {
        "with": f"{head}Project-URL: Source, {REPOSITORY}\n\nProject-URL: no field",
        "none": f"{head}\nProject-URL: Source, in the description",
    }.items():
        with zipfile.ZipFile(tmp_path / f"{name}-1-py3-none-any.whl", "w") as wheel:
            wheel.writestr(f"{name}-1.dist-info/METADATA", text)
        with tarfile.open(tmp_path / f"{name}-1.tar.gz", "w:gz") as sdist:
            member = tarfile.TarInfo(f"{name}-1/PKG-INFO")
            member.size = len(text)
            sdist.addfile(member, io.BytesIO(text.encode()))
    assert without_address(tmp_path) == ["none-1-py3-none-any.whl", "none-1.tar.gz"]


def test_the_support_matrix_names_the_platforms_and_pythons_of_the_wheels() -> None:
    page = read("docs/support.md")
    machines = jobs()["wheels"]["strategy"]["matrix"]["machine"]
    assert {*machines} == {*MACHINES}
    rows = re.findall(r"^\| ((?:Linux|macOS) .*?) \(", page, re.MULTILINE)
    assert rows == [MACHINES[machine] for machine in machines]
    pythons = re.findall(r"^\| (3\.\d+) \|", page, re.MULTILINE)
    assert jobs("tests")["suite"]["strategy"]["matrix"]["python"] == pythons
    (step,) = steps_with(jobs()["wheels"], "pypa/cibuildwheel")
    built = step["env"]["CIBW_BUILD"].split()
    assert built == [f"cp{python.replace('.', '')}-*" for python in pythons]
    for folder in ("", "core/"):
        classes = project(folder)["classifiers"]
        named = [
            line.removeprefix("Programming Language :: Python :: ")
            for line in classes
            if " :: Python :: " in line
        ]
        assert named == pythons
        systems = {
            SYSTEMS[line.removeprefix("Operating System :: ")]
            for line in classes
            if line.startswith("Operating System")
        }
        assert systems == {row.partition(" ")[0] for row in rows}


@pytest.mark.parametrize(
    ("recipe", "folder"), [("handmap-core", "core/"), ("handmap-qp", "")]
)
def test_a_recipe_for_conda_needs_what_the_package_needs(
    recipe: str, folder: str
) -> None:
    content = parsed(f"conda/{recipe}/recipe.yaml")
    assert content["package"]["name"] == project(folder)["name"] == recipe
    version = content["context"]["version"]
    assert version == handmap_qp.__version__
    run = [
        each.replace("${{ version }}", version)
        for each in content["requirements"]["run"]
        if each.partition(" ")[0] != "python"
    ]
    expected = []
    for requirement in project(folder)["dependencies"]:
        parts = re.fullmatch(r"([\w-]+)(.*)", requirement)
        assert parts is not None
        expected.append(f"{CONDA_NAMES.get(parts[1], parts[1])} {parts[2]}")
    assert sorted(run) == sorted(expected)
    # The tools of the build, too.
    tools = tomllib.loads(read(f"{folder}pyproject.toml"))["build-system"]["requires"]
    host = {each.replace(" ", "") for each in content["requirements"]["host"]}
    assert {*tools} <= host
    for file in content["about"]["license_file"]:
        assert (ROOT / file).is_file(), file
    source = ROOT / "conda" / recipe / content["source"]["path"]
    assert source.resolve() == ROOT
    assert content["about"]["license"] == project(folder)["license"]
    used = [
        step["with"]["recipe-path"]
        for step in steps_with(jobs("tests")["conda"], "prefix-dev/")
    ]
    assert f"conda/{recipe}/recipe.yaml" in used
    # rattler-build knows no C library by itself.
    if '${{ stdlib("c") }}' in content["requirements"].get("build", []):
        assert "c_stdlib" in parsed(f"conda/{recipe}/variants.yaml")


def test_the_image_is_built_of_files_that_exist() -> None:
    text = re.sub(r"\\\n *", "", read("docs/deploy/Containerfile"))
    lines = [line for line in text.splitlines() if line and line[0] != "#"]
    words = {line.split()[0] for line in lines}
    assert words <= {
        *("FROM", "COPY", "RUN", "ENV", "USER", "VOLUME", "HEALTHCHECK"),
        *("STOPSIGNAL", "ENTRYPOINT"),
    }
    bases = {line.split()[1] for line in lines if line.startswith("FROM")}
    assert {re.sub(r"^python:(3\.\d+)-slim$", r"\1", base) for base in bases} <= {
        *jobs("tests")["suite"]["strategy"]["matrix"]["python"]
    }
    # Both packages are installed, with extras that exist, and an ordinary user runs the command.
    (install,) = (line for line in lines if "pip install" in line)
    extras = re.findall(r"/source/core '/source\[([\w,]+)\]'$", install)
    assert extras
    assert {*extras[0].split(",")} <= {*project()["optional-dependencies"]}
    order = [line.split()[0] for line in lines]
    assert order.index("USER") < order.index("ENTRYPOINT")
    (build,) = (
        step["run"]
        for step in jobs("tests")["image"]["steps"]
        if "docker build" in step.get("run", "")
    )
    assert "--file docs/deploy/Containerfile ." in build
    ignored = {*read(".dockerignore").splitlines()}
    assert not ignored & {".ci", "README.md", "core", "handmap_qp", "urdf", "LICENSE"}


def test_the_manifest_of_ros_is_what_catkin_pkg_accepts() -> None:
    root = ET.fromstring(read("packages/ros2/package.xml"))
    assert root.attrib == {"format": "3"}
    assert root.findtext("name") == "handmap_ros2"
    assert root.findtext("license") == "Apache-2.0"
    assert re.fullmatch(r"\d+\.\d+\.\d+", root.findtext("version", ""))
    (maintainer,) = root.iter("maintainer")
    assert maintainer.text == project()["authors"][0]["name"]
    # As catkin_pkg.package.Person checks it.
    word = r"[-a-zA-Z0-9_%+]+"
    domain = r"[-a-zA-Z0-9%]+(\.[-a-zA-Z0-9%]+)*\.[a-zA-Z]{2,}"
    email = maintainer.attrib["email"]
    assert re.fullmatch(rf"{word}(\.{word})*@{domain}", email)
    # There is no mailbox yet, and the page of releases says so.
    if email.endswith(".invalid"):
        assert "`packages/ros2/package.xml`: bloom refuses" in read("docs/release.md")
    needed = [tag.text for tag in root.iter("exec_depend")]
    assert len({*needed}) == len(needed)
    launch = read("packages/ros2/launch/handmap.launch.py")
    imported = {*re.findall(r"^(?:from|import) (\w+)", launch, re.MULTILINE)}
    assert imported - sys.stdlib_module_names <= {*needed}
    assert root.findtext("export/build_type") == "ament_python"


def test_a_reader_finds_a_contact_and_how_to_cite() -> None:
    citation = parsed("CITATION.cff")
    assert citation["contact"][0]["name"] == citation["authors"][0]["name"]
    assert citation["license"] == "Apache-2.0"
    # On GitHub, SECURITY.md is at OWNER/NAME/blob/BRANCH.
    assert "](../../security/advisories/new)" in read("SECURITY.md")
    page = read("docs/support.md")
    for heading in ("Status", "Support matrix", "Where to ask", "How to cite"):
        assert f"\n## {heading}\n" in page
    paper = citation["references"][0]
    assert paper["title"] in page
    for author in paper["authors"]:
        assert f"{author['given-names']} {author['family-names']}" in page
    assert "docs/support.md" in read("README.md")


def test_dependabot_reads_folders_that_have_something_to_update() -> None:
    updates = parsed(".github/dependabot.yml")["updates"]
    folders = {each["package-ecosystem"]: each["directory"] for each in updates}
    assert folders == {"github-actions": "/", "docker": "/docs/deploy"}
    assert (ROOT / "docs" / "deploy" / "Containerfile").is_file()


def test_mink_needs_qpsolvers_as_the_page_of_dependencies_says() -> None:
    # If it no longer does, qpsolvers can become an extra.
    needed = metadata.requires("mink") or []
    assert any(line.startswith("qpsolvers") for line in needed)
    assert "mink needs it" in read("docs/dependencies.md")


def test_the_page_of_releases_names_all_jobs_and_environments() -> None:
    page = read("docs/release.md")
    for job in jobs():
        assert f"`{job}`" in page, job
    for environment in ("pypi-core", "pypi", "pypi-FOLDER"):
        assert f"`{environment}`" in page
