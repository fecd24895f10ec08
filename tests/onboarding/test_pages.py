"""The pages about hands: their example works, and their reference is that of the code."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

from handmap_qp import load_hand
from handmap_qp.apps.onboarding.check import check_hand

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "hand_yaml.md"
FINGERS = {"thumb": (-0.04, 0.03), "index": (-0.015, 0.09), "middle": (0.015, 0.09)}
# The thumb bends across the palm, the others towards it.
AXES = {"thumb": "0.3 -0.2 -1", "index": "-1 0 0", "middle": "-1 0 0"}


def urdf() -> str:
    """Make the hand of the example: two joints a finger, phalanges of 40 and 30 mm."""
    parts = ['<link name="palm"/>']
    for finger, (x, y) in FINGERS.items():
        parent = "palm"
        for k, part in enumerate(("proximal", "distal"), start=1):
            link = f"{finger}_{part}"
            place = f"{x} {y} 0" if k == 1 else "0 0.04 0"
            shape = '<origin xyz="0 0.015 0"/><geometry><box size="0.012 0.03 0.012"/></geometry>'
            parts.append(
                f'<link name="{link}"><collision>{shape}</collision></link>'
                f'<joint name="{finger}_{k}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{link}"/><origin xyz="{place}"/><axis xyz="{AXES[finger]}"/>'
                '<limit lower="-0.1" upper="1.6" effort="1" velocity="6"/></joint>'
            )
            parent = link
    return f'<robot name="my_hand">{"".join(parts)}</robot>'


def test_the_example_by_hand_loads_and_passes_its_check(tmp_path: Path) -> None:
    (example,) = re.findall(
        r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    )
    (tmp_path / "hand.yaml").write_text(example, encoding="utf-8")
    (tmp_path / "hand.urdf").write_text(urdf(), encoding="utf-8")
    hand = load_hand(tmp_path / "hand.yaml")
    assert hand.name == "my_hand"
    report = check_hand(str(tmp_path / "hand.yaml"), has_motion=False)
    wrong = [
        finding for finding in report.findings if finding.level in ("error", "warning")
    ]
    assert [finding for finding in wrong if finding.key != "points"] == []


def test_the_reference_is_that_of_the_code() -> None:
    page = runpy.run_path(str(DOCS / "hand_yaml.py"), run_name="hand_yaml")
    assert page["page"]() == PAGE.read_text(encoding="utf-8"), (
        "run python docs/hand_yaml.py"
    )


def test_every_key_has_a_meaning() -> None:
    page = runpy.run_path(str(DOCS / "hand_yaml.py"), run_name="hand_yaml")
    for kind in page["SECTIONS"].values():
        meanings = page["attribute_texts"](kind)
        assert set(meanings) == set(kind.__struct_fields__), kind
        assert all(text.endswith(".") for text in meanings.values())


def test_the_table_of_hands_has_a_row_for_each_hand_without_a_download() -> None:
    text = (DOCS / "hands.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\w+) \| \d+ \|", text, re.MULTILINE)
    for name in ("allegro_right", "hey5", "three_finger", "romeo_left", "g1_right"):
        assert name in rows
