"""`hands edit` opens a description whose palm is fixed to a wrong link."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_hands import BoxHand
from msgspec.structs import replace

from handmap_qp import HandSpec, load_hand
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.palm_repairs import loadable
from handmap_qp.apps.onboarding.palm_turns import with_palm_link
from handmap_qp.apps.onboarding.write import write_hand
from handmap_qp.errors import HandError
from handmap_qp.hands.spec import read_hand_spec

TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture
def right(tmp_path: Path) -> HandSpec:
    file = tmp_path / "box.urdf"
    file.write_text(BoxHand(turn=TURN).urdf(), encoding="utf-8")
    return detect(file).spec


def _written(spec: HandSpec, folder: Path) -> Path:
    file = folder / "hand.yaml"
    write_hand(Detection(spec, (), (), {}), file)
    return file


def _opened(file: Path) -> tuple[HandSpec, str]:
    found, remark = loadable(file)
    return load_hand(found).spec, remark


@pytest.mark.parametrize("link", ["index_0", "index_1", "thumb_1"])
def test_a_palm_on_a_finger_goes_back_to_the_palm_with_its_axes(
    link: str, right: HandSpec, tmp_path: Path
) -> None:
    wrong = with_palm_link(load_hand(right), link)
    file = _written(wrong, tmp_path)
    with pytest.raises(HandError, match="moves with joints of the hand"):
        load_hand(file)
    spec, remark = _opened(file)
    assert spec.palm.link == right.palm.link
    np.testing.assert_allclose(spec.palm.distal, right.palm.distal, atol=1e-9)
    np.testing.assert_allclose(spec.palm.dorsal, right.palm.dorsal, atol=1e-9)
    np.testing.assert_allclose(spec.palm.xyz, right.palm.xyz, atol=2e-4)
    # It says what was wrong and what it is now, and changes no file.
    assert link in remark
    assert f"fixed to {right.palm.link!r}" in remark
    assert read_hand_spec(file).palm.link == link


def test_a_palm_on_a_link_that_does_not_exist_is_found_again(
    right: HandSpec, tmp_path: Path
) -> None:
    palm = replace(
        right.palm, link="no_link", distal=right.palm.dorsal, dorsal=right.palm.distal
    )
    spec, remark = _opened(_written(replace(right, palm=palm), tmp_path))
    assert spec.palm == right.palm
    assert "no link 'no_link'" in remark


def test_a_right_description_is_opened_as_it_is(
    right: HandSpec, tmp_path: Path
) -> None:
    file = _written(right, tmp_path)
    assert loadable(file) == (file, "")
    assert loadable("allegro_left") == ("allegro_left", "")


def test_other_errors_stay(right: HandSpec, tmp_path: Path) -> None:
    wrong = replace(right, wrist=replace(right.wrist, link="index_0"))
    file = _written(wrong, tmp_path)
    assert loadable(file) == (file, "")
    with pytest.raises(HandError):
        load_hand(file)
    assert loadable(tmp_path / "no.yaml") == (tmp_path / "no.yaml", "")
