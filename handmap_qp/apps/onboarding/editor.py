"""The command `handmap hands edit`: a page that shows a hand, and corrects its description."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional

from handmap_core.se3 import Array, inverse_pose, transform_points
from handmap_qp.apps.arguments import HandName, hinted
from handmap_qp.apps.viewer.controls import add_controls, reporting
from handmap_qp.apps.viewer.figure import place_node
from handmap_qp.apps.viewer.sample import Variant, ViewSample
from handmap_qp.apps.viewer.scene import HandScene
from handmap_qp.apps.viewer.serving import ViserServer, run_frames, showing
from handmap_qp.hands import (
    FINGERS,
    ROBOT_FILES,
    find_fingers,
    finger_tips,
    load_hand,
)
from . import edit
from .detect import Detection, detect
from .gestures import draw_gestures
from .write import check_free, open_source, write_hand

# Length and radius of the palm's axes, and length of the arrows, in radii of the hand.
_AXES = 1.2
_AXIS = 0.03
_ARROWS = 0.3
# Step of the joints [rad or m].
_STEP = 0.001


@dataclass(frozen=True)
class HandsEdit:
    """Correct a hand's description in the browser: palm, side, fingers, tips and rest posture.

    Shows the hand, and gestures of the package's recording as they are mapped to it, with scores.
    Turn the palm over, rename fingers, drag tips, move the joints to where the hand rests. Where it
    is uncertain to which side a fist closes, choose the picture of one. Save writes the hand.yaml,
    with comments. The hand of a URDF or MJCF file is described first, as by `handmap hands init`;
    run that, with its --root, for one of two hands.

    Examples:
        handmap hands edit my_hand/hand.yaml --open
        handmap hands edit my_hand.urdf --open
        handmap hands edit allegro_right --out mine.yaml

    Attributes:
        hand: Path of a hand.yaml, URDF or MJCF file, or name of a hand of the package.
        out: File to write.
        overwrite: Replace the file if it exists and is not HAND.
        open: Open the browser.
    """

    hand: Positional[HandName]
    out: Annotated[
        Path | None, hinted("FILE.yaml", "(default: HAND, or its name with .yaml)")
    ] = None
    overwrite: bool = False
    open: bool = False

    def run(self) -> None:
        """Show the page until interrupted."""
        given = Path(self.hand)
        out = self.out or given.with_suffix(".yaml")
        check_free(out, overwrite=self.overwrite or out == given)
        if given.suffix.lower() in ROBOT_FILES:
            source = open_source(given)
            found = edit.described(detect(source.urdf), source)
        else:
            found = edit.open_description(given)
        with showing("127.0.0.1", 8080, opens=self.open) as server:
            run_frames(HandEditor(server, found, out).tick)


class HandEditor:
    """The page of a description, `found`, which Save writes to the file `out`.

    viser calls callbacks in threads of its own: they record what `tick` carries out, or ask first.
    """

    def __init__(self, server: ViserServer, found: Detection, out: Path) -> None:
        self.out = out
        self._requests = []
        self._mapped = None
        self._pictures: Any = None
        self._take(found)
        self._gui = server.gui
        self._add_controls()
        self._scene = HandScene(server, None, [self._shown(self.hand.rest)])
        self._add_handles(server.scene)
        self._show()

    def _add_controls(self) -> None:
        """Add controls, fingers and joints on the left, room for gestures on the right."""
        gui = self._gui
        gui.main_panel.dock_left()
        panel = gui.add_panel()
        self._tab = panel.add_tab("Gestures")
        panel.dock_right()
        controls = add_controls(gui, "editing", self._press)
        self.message, self.status = controls[-2:]
        hand = self.hand
        with gui.add_folder("fingers"):
            self.names: dict[str, Any] = {
                tip.link: gui.add_dropdown(tip.link, FINGERS)
                for tip in hand.reference_points
            }
        ranges = np.vstack([hand.limits, hand.rest]).T.tolist()
        with gui.add_folder("joints"):
            self.joints = [
                gui.add_slider(name, low, high, _STEP, rest)
                for name, (low, high, rest) in zip(
                    hand.joint_names, ranges, strict=True
                )
            ]

    def _add_handles(self, scene: Any) -> None:
        """Add the palm's axes, and a name and arrows to drag it by at each tip."""
        (figure,) = self._scene.robots
        size = figure.radius
        self._palm = scene.add_frame(
            "/robot/palm",
            axes_length=_AXES * size,
            axes_radius=_AXIS * size,
        )
        self.arrows = {}
        self._labels = {}
        for link, node in figure.links.items():
            node.on_click(lambda event, at=link: self._ask(at, event.client.gui))
        for link in self.names:
            path = f"/robot/{link}"
            self.arrows[link] = arrows = scene.add_transform_controls(
                path,
                _ARROWS * size,
                disable_sliders=True,
                disable_rotations=True,
                depth_test=False,
            )
            arrows.on_update(
                lambda event, at=link: event.phase == "end" and self._press("tip", at)
            )
            self._labels[link] = scene.add_label(f"{path}/name", "")

    def _press(self, name: str, which: Any) -> None:
        """Record a request, and what it is about: a browser, both names, or a tip's link."""
        self._requests.append((name, which))

    def tick(self, _: float = 0.0) -> None:
        """Carry out the user's requests, map the gestures, and draw."""
        for tip in self.hand.reference_points:
            name = self.names[tip.link].value
            if name != tip.finger:
                self._press("name", (tip.finger, name))
        while self._requests:
            with reporting(self.message, ""):
                self._act(*self._requests.pop(0))
            self._show()
        self._map()
        self._draw()

    def _act(self, request: str, which: Any) -> None:
        """Carry out a request."""
        hand = self.hand
        spec = hand.spec
        match request:
            case "save":
                write_hand(self.found, self.out)
                which.add_notification("Saved", f"wrote {self.out}")
            case "turn":
                spec = edit.with_palm_turned(hand)
            case "side":
                spec = edit.with_other_side(hand)
            case "rest":
                spec = edit.with_rest(hand, self._q)
            case "name":
                spec = edit.with_finger(hand, *which)
            case "tip":
                (pose,) = hand.link_poses([which], self._q)
                place = np.array(self.arrows[which].position)
                xyz = transform_points(inverse_pose(pose), place)
                spec = edit.with_tip(hand, self._labels[which].text, xyz)
            case "right":
                spec = edit.with_other_palm(hand)
        known = ("dorsal", "side") if request == "left" else ()
        self._take(edit.corrected(self.found, spec, *known))

    def _ask(self, link: str, gui: Any) -> None:
        """Ask for the name of the finger that a link is of, if it is of one."""
        hand = self.hand
        joint = hand.frames[link].parentJoint
        fingers = find_fingers(hand).values()
        if finger := next((f.name for f in fingers if joint in f.own), ""):
            with gui.add_modal(f"Name the finger that is called {finger}") as modal:
                names = gui.add_button_group("", FINGERS)

            @names.on_click
            def _(_: Any) -> None:
                self._press("name", (finger, names.value))
                modal.close()

    def _take(self, found: Detection) -> None:
        """Take a description, if it can be loaded."""
        hand = load_hand(found.spec)
        self.hand = hand.with_points([*finger_tips(hand).values()])
        self.found = found

    @property
    def _q(self) -> Array:
        """The joint angles that are shown."""
        return np.array([joint.value for joint in self.joints])

    def _shown(self, q: Array) -> Variant:
        hand = self.hand
        wrist = hand.frame_pose("wrist", q)
        points = hand.points(q)
        sample = ViewSample(time=0, robot_q=q, robot_wrist=wrist, robot_points=points)
        return Variant(f"a {hand.side} hand", hand, None, [sample])

    def _show(self) -> None:
        """Show fingers by their names, and the hand with its palm upright."""
        for tip in self.hand.reference_points:
            self.names[tip.link].value = self._labels[tip.link].text = tip.finger
        self._scene.set_variants([self._shown(self.hand.rest)])
        self._drawn = None

    def _draw(self) -> None:
        """Draw the posture if it has changed."""
        q = self._q
        if q.tolist() != self._drawn:
            self._drawn = q.tolist()
            self._scene.draw(self._shown(q).samples)
            place_node(self._palm, self.hand.frame_pose("palm", q))
            for tip in self.hand.reference_points:
                pose = self.hand.frame_pose(tip.name, q)
                self.arrows[tip.link].position = pose[:3, 3]
        self._scene.cameras.update()

    def _map(self) -> None:
        """Show the gestures as mapped if the description has changed, with their scores.

        If it is uncertain to which side a fist closes, ask which of two is one.
        """
        if self._mapped is self.found:
            return
        gui = self._gui
        with reporting(self.status, "mapping the gestures …"):
            shown, scores = draw_gestures(self.hand)
            if self._pictures:
                self._pictures.remove()
            with self._tab:
                self._pictures = gui.add_folder("as mapped")
            with self._pictures:
                gui.add_markdown(scores)
                certainty = {clue.what: clue.certainty for clue in self.found.clues}
                if certainty.get("dorsal", "certain") != "certain":
                    turned = load_hand(edit.with_other_palm(self.hand))
                    others, _ = draw_gestures(turned)
                    fists = np.hstack([shown["fist"][1], others["fist"][1]])
                    gui.add_image(fists, label="Which picture is a fist?")
                    add_controls(gui, "choosing", self._press)
                for name, picture in shown.items():
                    gui.add_image(np.hstack([*picture]), label=name)
        self._mapped = self.found
