"""`tactomo bench`: every method and all it is compared with is in the one table."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from small_sensor import SMALL
from tactomo.cli import app
from tactomo.cli.bench_methods import HOW_TO_GET_PYEIT, PRODUCT, PYEIT_GN, PYEIT_STEP
from tactomo_models import METHODS
from tactomo_models.evaluation.trade_off import BUDGETED
from typer.testing import CliRunner


@pytest.mark.slow
@pytest.mark.parametrize("has_pyeit", [True, False])
def test_every_method_is_timed_beside_what_it_is_compared_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_pyeit: bool
) -> None:
    if has_pyeit:
        pytest.importorskip("pyeit")
    else:
        monkeypatch.setitem(sys.modules, "pyeit.eit.jac", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    sensor = tmp_path / "small.toml"
    sensor.write_text(SMALL)
    result = CliRunner().invoke(app, ["bench", "--no-live", "--json", "-d", str(sensor)])
    assert result.exit_code == 0, result.output
    rows = {
        (r["method"], r["contacts"], r["state"]): r for r in json.loads(result.stdout)["methods"]
    }
    linear, compared = ("tikhonov", "noser"), (PYEIT_STEP, PYEIT_GN)
    untrained = {m for (m, _, _), row in rows.items() if m in METHODS and row["note"]}
    assert not untrained & {"auto", "fit", "levelset", "pls-paper", *linear}
    stateful = [method for method in BUDGETED if method not in untrained]
    images = [f"{method}, image alone" for method in linear]
    one_state = {*METHODS, *images, *compared} - set(stateful)
    assert rows.keys() == {
        (PRODUCT, 0, "any"),
        ("auto", 0, "any"),
        *((method, contacts, "any") for method in one_state for contacts in (1, 2)),
        *(
            (method, contacts, state)
            for method in stateful
            for contacts in (1, 2)
            for state in ("cold", "warm", "moving")
        ),
    }
    for (method, _, _), row in rows.items():
        if method in compared and not has_pyeit:
            assert row["note"] == HOW_TO_GET_PYEIT
            assert row["p50_ms"] is None
            continue
        if method in untrained:
            continue
        assert 0 < row["p50_ms"] <= row["p99_ms"]
        assert row["of_product"] > 0
        if method in METHODS:
            assert sum(row["stage_ms"].values()) <= 1.5 * row["p50_ms"]
            assert "data" in row["stage_ms"]
    assert rows[PRODUCT, 0, "any"]["of_product"] == 1
    assert rows["pls-paper", 1, "any"]["of_paper"] == 1
    assert (rows["auto", 1, "warm"]["of_pyeit"] is not None) is has_pyeit
