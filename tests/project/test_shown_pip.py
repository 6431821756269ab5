"""The lines of pip on the pages, run as they are shown, in virtual environments of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from typing import TYPE_CHECKING

import pytest
from project.test_shown_programs import others
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources]
README = (
    "pip install --require-hashes -r requirements.lock -r requirements-build.lock",
    "pip install --no-deps --no-build-isolation .",
)
# Both are typed where daqsvc is installed: pip then takes the extra of that one.
MORE = ("pip install 'daqsvc[fleet]'", "pip install 'psycopg[binary]' paho-mqtt")
SERVICE = (
    "python3.11 -m venv /opt/daqsvc",
    "/opt/daqsvc/bin/pip install --require-hashes -r requirements-service.lock",
    "/opt/daqsvc/bin/pip install --no-deps dist/daqsvc-*.whl",
)
RELEASE = (
    "python3.11 -m venv /tmp/try",
    # The same packages as above, and 772 MB: that they are found is enough.
    "/tmp/try/bin/pip install --dry-run --require-hashes -r requirements.lock",  # noqa: S108 - as shown
    "/tmp/try/bin/pip install --no-deps dist/*.whl",  # noqa: S108
)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clone, as those who read the pages have one."""
    try:
        urllib.request.urlopen("https://pypi.org/simple/pip/", timeout=10).close()
    except (urllib.error.URLError, OSError) as error:
        if os.environ.get("DAQSVC_REQUIRE_CHROMIUM"):
            raise  # CI, which has installed all from there
        pytest.skip(f"the package index cannot be reached: {error}")
    folder = tmp_path_factory.mktemp("clone") / "daqsvc"
    subprocess.run(["git", "clone", "--quiet", ROOT, folder], check=True)
    return folder


def typed(line: str, tree: Path, places: dict[str, Path]) -> None:
    """Run a line of a page in the tree, with other places than those of a real computer."""
    for place, instead in places.items():
        line = line.replace(place, f"{instead}")
    venv = f"{tree.parent / 'venv' / 'bin'}"
    environment = {
        **{key: value for key, value in os.environ.items() if not key.startswith(("PIP_", "PYTHON"))},
        "PATH": f"{venv}:{os.environ['PATH']}",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PIP_ROOT_USER_ACTION": "ignore",
    }
    done = subprocess.run(
        ["bash", "-c", line], cwd=tree, env=environment, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


def test_these_are_the_lines_that_are_shown() -> None:
    shown = {line.replace("'", "") for _, line, words in others() if "pip" in words[0] or "venv" in words}
    mine = {line.replace("'", "").replace(" --dry-run", "") for line in (*README, *MORE, *SERVICE, *RELEASE)}
    assert shown - mine == {".venv/bin/pip install -e /path/to/package"}
    assert mine - shown == set()


@pytest.mark.timeout(1500)  # on a busy computer
def test_lines_of_pip_install_what_they_say(tree: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", tree.parent / "venv"], check=True)
    for line in (*README, *MORE):
        typed(line, tree, {})
    typed("daqsvc --version && python -c 'import dask, distributed, psycopg, paho.mqtt'", tree, {})
    typed("pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .", tree, {})
    places = {"/opt/daqsvc": tree.parent / "opt", "/tmp/try": tree.parent / "try"}  # noqa: S108 - as shown
    for line in (*SERVICE, *RELEASE):
        typed(line, tree, places)
    typed("/opt/daqsvc/bin/daqsvc example laval-rig --out machine.toml", tree, places)
    typed("/opt/daqsvc/bin/daqsvc check machine.toml", tree, places)
    shutil.rmtree(tree.parent)
