"""A method of the user's own has a score: a file with one function, from landmarks to joints.

The file is that of the page on comparing methods. The path ends well only if the function has a
score of its own beside the package's method, and another one when the function is another one.
"""

from __future__ import annotations

import json

from paths.fresh import stop
from paths.newcomer import Newcomer, code_of

TITLE = "A method of one's own"
PAGE = "docs/compare.md"
METHOD = "mine.py:joints"
SCORE = f"handmap score {METHOD} --hands allegro_right --seeds 0"
INSTALL = "pip install packages/score"
COMMANDS = {INSTALL: "docs/score.md", SCORE: PAGE}
_STILL = """
import numpy as np

def joints(landmarks):
    return np.full(16, 0.3)
"""


def score(path: Newcomer) -> dict[str, float]:
    """Type the command, and return the score of each method."""
    path.enter(SCORE)
    if not (path.work / "score" / "score.html").is_file():
        stop("the page of scores is missing")
    written = json.loads((path.work / "score" / "score.json").read_text("utf-8"))
    scores = {each["mapping"]: each["score"] for each in written["overview"]}
    path.note(", ".join(f"{name} {value:.1f}" for name, value in scores.items()))
    return scores


def main() -> None:
    """Go the path."""
    with Newcomer(TITLE, "robots", "plot", commands=COMMANDS) as path:
        path.enter(INSTALL)
        mine = path.work / "mine.py"
        mine.write_text(code_of(PAGE, mine.name), encoding="utf-8")
        first = score(path)
        if not 0.0 < first[METHOD] <= 100.0 or len(first) < 2:
            stop(f"expected a score of {METHOD} beside another method, got {first}")
        mine.write_text(_STILL, encoding="utf-8")
        second = score(path)
        if second[METHOD] >= first[METHOD]:
            stop("a hand that stands still has no lower score")


if __name__ == "__main__":
    main()
