"""The study in Chromium: a person finishes it, and `handmap study` reads the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from browser import Browser

from handmap_qp.apps.study.result_file import LABELS, read_result

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results(page: Browser, address: str) -> dict[str, Any]:
    """Return what a recorded hand does in the study, which gives up what it cannot."""
    page.open(f"{address}study.html")
    page.wait_for(
        "window.study && study.balls && Object.keys(study.balls).length === 2"
    )
    assert page.evaluate("document.getElementById('begin').disabled")
    page.evaluate(
        "document.getElementById('input').add(new Option('recording', 'recording'));"
        "document.getElementById('input').value = 'recording';"
        "document.getElementById('agree').click();"
        "document.getElementById('begin').click()"
    )
    for mapping in range(2):
        for task in range(2):
            page.wait_for("!document.getElementById('trial').hidden && !study.trial")
            assert f"{mapping + 1} of 2" in page.evaluate(
                "document.getElementById('task').textContent"
            )
            page.evaluate("document.getElementById('start').click()")
            done = 2 * mapping + task + 1
            page.wait_for(
                f"study.results.trials.length === {done} || study.time - study.trial.began > 20"
            )
            page.evaluate(
                f"if (study.results.trials.length < {done})"
                " document.getElementById('give-up').click()"
            )
        page.wait_for("!document.getElementById('questions').hidden")
        page.evaluate(
            "[...document.querySelectorAll('#scales input')].forEach((each, i) => {"
            f" each.value = {10 * mapping} + 5 * i; }});"
            "document.getElementById('answer').click()"
        )
    page.wait_for("!document.getElementById('choice').hidden")
    page.evaluate("document.querySelector('[data-choice=second]').click()")
    page.wait_for("document.getElementById('file').href.startsWith('blob:')")
    return page.evaluate(
        "fetch(document.getElementById('file').href).then((answer) => answer.json())"
    )


def test_the_file_is_one_of_handmap_study(
    results: dict[str, Any], tmp_path: Path
) -> None:
    file = tmp_path / "study.json"
    file.write_text(json.dumps(results))
    found = read_result(file)
    assert sorted(found.order) == [*LABELS]
    assert found.hand == "allegro_right"
    assert found.preference == found.order[1]
    assert [found.mappings.A.name, found.mappings.B.name] == [
        "teleoperation",
        "picking",
    ]
    assert len(found.trials) == 4
    assert found.workload_of(found.order[0]).scales()["physical"] == 5.0
    assert found.workload_of(found.order[1]).scales()["physical"] == 15.0


def test_a_hand_that_pinches_touches_the_ball(results: dict[str, Any]) -> None:
    """The recording brings thumb and index together, by both mappings."""
    index = [each for each in results["trials"] if each["task"].endswith("index")]
    assert len(index) == 2
    assert all(each["is_success"] and each["seconds"] < 20.0 for each in index)


def test_a_hand_that_is_open_touches_nothing(page: Browser, address: str) -> None:
    page.open(f"{address}study.html")
    page.wait_for(
        "window.study && study.balls && Object.keys(study.balls).length === 2"
    )
    page.evaluate(
        "document.getElementById('agree').click(); document.getElementById('begin').click()"
    )
    page.wait_for("!document.getElementById('trial').hidden")
    page.evaluate("document.getElementById('start').click()")
    page.wait_for("study.trial && study.time - study.trial.began > 2")
    assert page.evaluate("study.trial.touchedSince") is None
    page.evaluate("document.getElementById('give-up').click()")
    assert page.evaluate("study.results.trials[0].is_success") is False
