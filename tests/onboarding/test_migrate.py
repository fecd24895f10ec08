"""Configurations of dex-retargeting become descriptions with the same reference points."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handmap_qp import HandMapper, cli, load_hand
from handmap_qp.apps.onboarding.migrate import migrate
from handmap_qp.errors import HandmapError
from handmap_qp.hands import FINGERS
from handmap_qp.hands.sources import urdf_path

TIPS = {
    "thumb": "link_15.0_tip",
    "index": "link_3.0_tip",
    "middle": "link_7.0_tip",
    "ring": "link_11.0_tip",
}
VECTOR = f"""
retargeting:
  type: vector
  urdf_path: allegro.urdf
  target_origin_link_names: [palm_link, palm_link, palm_link, palm_link]
  target_task_link_names: [{", ".join(TIPS.values())}]
  target_link_human_indices: [[0, 0, 0, 0], [4, 8, 12, 16]]
  scaling_factor: 1.6
  low_pass_alpha: 0.2
"""
DEXPILOT = f"""
retargeting:
  type: DexPilot
  urdf_path: allegro.urdf
  wrist_link_name: palm_link
  finger_tip_link_names: [{", ".join(TIPS.values())}]
"""
POSITION = f"""
retargeting:
  type: position
  urdf_path: allegro.urdf
  target_link_names: [{", ".join(TIPS.values())}, link_14.0, link_2.0]
  target_link_human_indices: [4, 8, 12, 16, 2, 6]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with a link to the Allegro hand's URDF, as a configuration names it."""
    (tmp_path / "allegro.urdf").symlink_to(urdf_path(load_hand("allegro_right").spec))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "text", [VECTOR, DEXPILOT, POSITION], ids=["vector", "dexpilot", "points"]
)
def test_links_become_reference_points_of_a_hand_that_maps(
    folder: Path, text: str
) -> None:
    (folder / "config.yml").write_text(text)
    assert cli.main(["hands", "migrate", "config.yml"]) == 0
    hand = load_hand(folder / "hand.yaml", points="fingertips")
    assert {point.finger: point.link for point in hand.reference_points} == TIPS
    # Its own description knows the same fingers by their names.
    own = load_hand("allegro_right", points="fingertips")
    q = [own.rest[own.joint_names.index(name)] for name in hand.joint_names]
    order = [hand.reference_points.index(point) for point in own.reference_points]
    for tip, other in zip(own.points(own.rest), hand.points(q)[order], strict=True):
        np.testing.assert_allclose(
            np.linalg.norm(tip - own.points(own.rest)[0]),
            np.linalg.norm(other - hand.points(q)[order][0]),
            atol=1e-9,
        )
    human = load_hand("human")
    step = HandMapper(human, load_hand(folder / "hand.yaml"), dt=1 / 60).map_step(
        human.rest, np.eye(4)
    )
    assert np.isfinite(step.command.q).all()


FIVE = ("thumb_tip", "index_tip", "middle_tip", "ring_tip", "pinky_tip")
# Links of dex-retargeting's own configurations, in the order of a person's fingers.
LINKS = {
    "ability_right": FIVE,
    "inspire_right": FIVE,
    "svh_right": ("thtip", "fftip", "mftip", "rftip", "lftip"),
    "leap_right": ("th_ds", "if_ds", "mf_ds", "rf_ds"),
    "panda_gripper": ("panda_leftfinger", "panda_rightfinger"),
}


def _configurations(links: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return a configuration of each type for the links of a hand, as dex-retargeting has them."""
    tips = [4, 8, 12, 16, 20][: len(links)]
    vector: dict[str, Any] = {
        "target_origin_link_names": ["wrist"] * len(links),
        "target_task_link_names": links,
        "target_link_human_indices": [[0] * len(links), tips],
    }
    if len(links) == 2:
        # A gripper has one vector from jaw to jaw.
        vector = {
            "target_origin_link_names": links[:1],
            "target_task_link_names": links[1:],
            "target_link_human_indices": [tips[:1], tips[1:]],
        }
    return {
        "vector": vector,
        "position": {"target_link_names": links, "target_link_human_indices": tips},
        "DexPilot": {"wrist_link_name": "wrist", "finger_tip_link_names": links},
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", LINKS)
def test_configurations_of_every_type_give_the_same_hand(
    name: str, tmp_path: Path
) -> None:
    try:
        own = load_hand(name)
        file = urdf_path(own.spec)
    except HandmapError as error:
        pytest.skip(str(error))
    links = LINKS[name]
    found = {}
    for kind, table in _configurations(links).items():
        config = tmp_path / f"{kind}.yml"
        text = {"retargeting": {"type": kind, "urdf_path": str(file)} | table}
        config.write_text(json.dumps(text))
        found[kind] = migrate(config, None, None).spec
        hand = load_hand(found[kind], points="fingertips")
        named = {point.finger: point.link for point in hand.reference_points}
        assert named == dict(zip(FINGERS, links, strict=False))
        human = load_hand("human" if hand.side == "right" else "human_left")
        step = HandMapper(human, hand, dt=1 / 60).map_step(human.rest, np.eye(4))
        assert np.isfinite(step.command.q).all()
    assert found["vector"] == found["position"] == found["DexPilot"]
    # A gripper has no side.
    assert len(links) == 2 or found["vector"].side == own.side


def test_points_besides_the_tips_are_taken_over(folder: Path) -> None:
    (folder / "config.yml").write_text(POSITION)
    assert cli.main(["hands", "migrate", "config.yml"]) == 0
    points = {
        point.name: point.link for point in load_hand(folder / "hand.yaml").spec.points
    }
    assert (points["thumb_mcp"], points["index_pip"]) == ("link_14.0", "link_2.0")


def test_settings_without_a_counterpart_are_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "config.yml").write_text(VECTOR)
    assert cli.main(["hands", "migrate", "config.yml"]) == 0
    printed = capsys.readouterr().out
    assert "scaling_factor is not used" in printed
    assert "low_pass_alpha is not used" in printed


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("a: [", "is not valid YAML"),
        ("hand: 1", "expected a table `retargeting`"),
        (
            VECTOR.replace("vector", "claw"),
            "type: expected vector, position or DexPilot",
        ),
        (
            VECTOR.replace("[4, 8, 12, 16]", "[4, 8, 12]"),
            "expected 4 indices of landmarks",
        ),
        (
            VECTOR.replace("[4, 8, 12, 16]", "[4, 8, 12, 61]"),
            "expected 4 indices of landmarks",
        ),
        (
            VECTOR.replace("[0, 0, 0, 0]", "[1, 0, 0]"),
            "expected 4 indices of landmarks from 0 to 20 for target_origin_link_names",
        ),
        (VECTOR.replace("link_3.0_tip", "link_99"), "no link 'link_99'"),
        (
            VECTOR.replace("link_3.0_tip", "palm_link"),
            "no joint moves the link 'palm_link'",
        ),
        (VECTOR.replace("allegro.urdf", "absent.urdf"), "give the file by --urdf"),
        (
            DEXPILOT.replace("finger_tip_link_names", "tips"),
            "expected a list of link names",
        ),
        (
            VECTOR.replace("  urdf_path: allegro.urdf\n", ""),
            "urdf_path: expected a path",
        ),
    ],
)
def test_a_configuration_that_cannot_be_used_is_one_line(
    folder: Path, text: str | None, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        (folder / "config.yml").write_text(text)
    assert cli.main(["hands", "migrate", "config.yml"]) == 2
    message = capsys.readouterr().err
    assert words in message
    assert message.count("\n") == 1
    assert not (folder / "hand.yaml").exists()
