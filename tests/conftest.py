"""Fixtures that several folders share: a real browser, the command line as a user runs it."""

from __future__ import annotations

import itertools
import os
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from needs import lacking
from selenium import webdriver
from selenium.common.exceptions import WebDriverException
from selenium.webdriver.chrome.service import Service
from tactomo.cli import main
from tactomo.ending import AS_WELL, ASKED
from tactomo_client.fake import FakeSensor
from threadpoolctl import threadpool_limits

pytest_plugins = ["model_fixtures"]

CHROMIUM_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--force-device-scale-factor=1",
    "--window-size=1280,900",
)


BEGUN_S = pytest.StashKey[float]()


# Nothing depends on the wall clock, nor on how fast the computer is, nor on chance: a change is not
# refused for what was there before it. For that look with `make test-random`.
PATIENT: dict[str, Any] = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("few", max_examples=20, derandomize=True, **PATIENT)
settings.register_profile("many", max_examples=100, derandomize=True, **PATIENT)  # `make test-all`
settings.register_profile("new", max_examples=100, **PATIENT)
settings.load_profile("few")


# A shell that starts this in the background ignores Ctrl-C, and so would the programs under test.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # likewise under `nohup`, which programs respect


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--reliability", metavar="PAGE", help="write what the fault suite finds to this page"
    )
    parser.addoption(
        "--scale", type=float, default=1.0, help="of the fault suite's long measures, do this share"
    )
    parser.addoption(
        "--seconds", type=float, help="modules in any order, and no test begins after so many"
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import nothing of the laboratory's for a run without its tests: that takes seconds."""
    return (collection_path.name == "lab" and "not lab" in config.option.markexpr) or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With --seconds, shuffle modules: where time is short, each has its turn sooner or later."""
    if config.getoption("seconds") is not None:
        paths = list(dict.fromkeys(item.path for item in items))
        random.shuffle(paths)
        items.sort(key=lambda item: paths.index(item.path))


def pytest_sessionstart(session: pytest.Session) -> None:
    session.config.stash[BEGUN_S] = time.monotonic()


def pytest_runtest_setup(item: pytest.Item) -> None:
    seconds = item.config.getoption("seconds")
    if seconds is not None and time.monotonic() - item.config.stash[BEGUN_S] > seconds:
        pytest.skip("the time is up")


@pytest.fixture(scope="session", autouse=True)
def _own_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is kept on this computer, such as calibrations of skins, does not get into tests.

    Models are built anew, as on a fresh machine, once for all workers.
    """
    run = tmp_path_factory.getbasetemp()
    run = run.parent if "PYTEST_XDIST_WORKER" in os.environ else run
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("data")))
        patch.setenv("XDG_CACHE_HOME", str(run / "cache"))
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        for name in ("STATE_DIRECTORY", "CACHE_DIRECTORY", "RUNTIME_DIRECTORY"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture(scope="session")
def _each_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folders that nobody has used; pytest's own would be numbered by a look at all before them."""
    parent = tmp_path_factory.mktemp("own")
    return (parent / str(number) for number in itertools.count())


@pytest.fixture(autouse=True)
def _own_data(monkeypatch: pytest.MonkeyPatch, _each_its_own: Iterator[Path]) -> None:
    """What one test's daemon keeps, such as its last reference, does not get into another's.

    Nor is one found that another test runs.
    """
    for name in ("XDG_DATA_HOME", "XDG_RUNTIME_DIR"):
        folder = next(_each_its_own)
        folder.mkdir(mode=0o700)
        monkeypatch.setenv(name, str(folder))


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """As the daemon runs; more threads only get into each other's way on a busy machine."""
    with threadpool_limits(1, user_api="blas"), pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPENBLAS_NUM_THREADS", "1")  # for the processes that tests start
        yield


@pytest.fixture(scope="module")
def _chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    program = program or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        lacking("needs Chromium and chromedriver on the PATH")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for option in CHROMIUM_OPTIONS:
        options.add_argument(option)
    profile: Path = tmp_path_factory.mktemp("chromium")
    options.add_argument(f"--user-data-dir={profile}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    try:
        browser = webdriver.Chrome(options, Service(driver))
    except WebDriverException as error:
        lacking(f"Chromium does not start: {error.msg}")
    yield browser
    browser.quit()


@pytest.fixture
def browser(_chromium: webdriver.Chrome) -> Iterator[webdriver.Chrome]:
    """A headless Chromium, 1280 × 900, showing an empty page. FrameRecord the test `browser`.

    `browser.get_log("browser")` has what pages wrote to the console since the test began.
    """
    _chromium.get_log("browser")  # type: ignore[no-untyped-call]  # reading empties it
    yield _chromium
    _chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    _chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    _chromium.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
    _chromium.get("about:blank")


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    """A sensor of the name `left` on a real socket, which says what a test has it say."""
    with FakeSensor("left") as sensor:
        yield sensor


@dataclass(frozen=True)
class Outcome:
    """What became of a command."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def tactomo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., Outcome]]:
    """Run `tactomo ARGUMENTS` in an empty folder, in this process, and say what became of it.

    Its exit status is asserted to be `status`, if one is given. Whatever is not told to the user
    as an error comes out as an exception here.
    """
    before = {number: signal.getsignal(number) for number in (*ASKED, *AS_WELL)}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: object, status: int | None = None) -> Outcome:
        monkeypatch.setattr("sys.argv", ["tactomo", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main()
        outcome = Outcome(int(exit_.value.code or 0), *capsys.readouterr())
        assert status in (None, outcome.returncode), outcome
        return outcome

    yield run
    for number, handler in before.items():
        signal.signal(number, handler)
