"""The twin says measured frames instead of simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tactomo.errors import TactomoError
from tactomo.recordings.imported_scans import ImportFileError
from tactomo_models import DataError, load_description
from tactomo_protocol import CommandCode, Hello
from waiting import wait_until

TANK = load_description("tank_disc")
ELECTRODES = 16
INJECTION = np.array([(k, (k + 1) % ELECTRODES) for k in range(ELECTRODES)])


def test_single_ended_frames_are_played_as_differences_again_and_again(
    bench: Callable[..., Any], tmp_path: Path
) -> None:
    path = tmp_path / "in.npz"
    volts = np.random.default_rng(0).normal(size=(3, ELECTRODES, ELECTRODES))
    np.savez(path, volts=volts * (1 + 0.1j), injection=INJECTION, t=[0.0, 0.1, 0.2])
    host = bench(sensor="tank_disc", play=path, rate_hz=None).host()
    host.send(CommandCode.IDENTIFY)
    hello = host.wait_for(lambda: host.kind(Hello))[0]
    assert hello.scan_rate_hz == pytest.approx(10.0)
    host.start()
    scans = host.wait_for(lambda: host.scans() if len(host.scans()) > 6 else [])
    drive, measure = TANK.pairs.drive[:, 0], TANK.pairs.measure
    want = volts[:, drive, measure[:, 0]] - volts[:, drive, measure[:, 1]]
    for scan in scans:
        got = scan.volts(hello.volts_per_count)
        assert got == pytest.approx(want[scan.counter % 3], abs=hello.volts_per_count)


@pytest.mark.slow
def test_a_file_played_once_ends_the_twin(bench: Callable[..., Any], tmp_path: Path) -> None:
    path = tmp_path / "in.npz"
    frames = np.arange(1.0, 6.0)[:, None] * np.ones(TANK.measurements)
    rest = np.full(TANK.measurements, 0.5)
    np.savez(path, structure=frames, structure_reference=rest)
    started = bench(sensor="tank_disc", play=path, play_once=True)
    host = started.host()
    host.send(CommandCode.IDENTIFY)
    host.start()
    host.wait_for(lambda: len(host.scans()) == 45)
    volts = [scan.volts(host.kind(Hello)[0].volts_per_count)[0] for scan in host.scans()]
    assert volts == pytest.approx([0.5] * 40 + [1.0, 2.0, 3.0, 4.0, 5.0], rel=1e-5)
    assert wait_until(lambda: started.twin.wait(0.0))
    assert len(host.scans()) == 45


def test_what_cannot_be_played_is_refused_at_once(
    bench: Callable[..., Any], tmp_path: Path
) -> None:
    with pytest.raises(ImportFileError, match="cannot read"):
        bench(sensor="tank_disc", play=tmp_path / "none.npz")
    path = tmp_path / "in.npz"
    np.savez(path, structure=np.ones((3, 192)))
    with pytest.raises(DataError, match="192"):
        bench(sensor="tank_disc", play=path)
    with pytest.raises(TactomoError, match="there is no protocol"):
        bench(sensor="tank_disc", protocol="morse")
