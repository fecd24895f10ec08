"""Keys of a `hand.yaml` that have had other names."""

from __future__ import annotations

from pathlib import Path

import pytest

from handmap_qp.errors import HandError
from handmap_qp.hands import hand_files, read_hand_spec


def test_a_key_and_its_former_name_exclude_each_other(tmp_path: Path) -> None:
    text = hand_files()["three_finger"].read_text(encoding="utf-8")
    file = tmp_path / "hand.yaml"
    file.write_text(f"{text}\nneutral_match: {{}}\nmatched: {{}}\n", encoding="utf-8")
    with pytest.raises(HandError, match="matched is the former name of neutral_match"):
        read_hand_spec(file)
