"""The command `handmap hands edit`: a page that shows a hand, and corrects its description."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import numpy as np
from tyro.conf import Positional

from handmap_core.errors import HandError, HandmapError
from handmap_core.se3 import (
    Array,
    inverse_pose,
    rotation_from_quat_wxyz,
    transform_points,
)
from handmap_qp.apps.addresses import check_port
from handmap_qp.apps.arguments import HandName, hinted
from handmap_qp.apps.viewer.controls import add_controls, reporting, say
from handmap_qp.apps.viewer.figure import place_node
from handmap_qp.apps.viewer.sample import Variant, ViewSample
from handmap_qp.apps.viewer.scene import HandScene
from handmap_qp.apps.viewer.serving import ViserServer, run_frames, showing
from handmap_qp.hands import (
    FINGERS,
    ROBOT_FILES,
    THUMB,
    Hand,
    HandSpec,
    Names,
    finger_by_joint,
    finger_tips,
    load_hand,
    urdf_path,
)
from . import edit
from .background import Background
from .choices import first_question
from .detect import Detection
from .finger_permutation import all_tips, exchanged, left_out, with_names
from .gesture_tab import GestureTab
from .hand_choice import (
    at_root,
    first_hand,
    links_of_hand,
    palm_links,
    possible_roots,
    with_thumb,
)
from .label_places import spread_labels
from .palm_repairs import loadable
from .palm_turns import (
    Held,
    Turn,
    snapped_axes,
    with_palm_axes,
    with_palm_link,
    with_turn,
)
from .single_joints import FingerKind
from .write import check_free, open_source, write_hand

# Length and radius of the palm's axes, and of the arrows and rings, in radii of the hand.
_AXES = 1.2
_AXIS = 0.03
_ARROWS = 0.3
_RINGS = 0.9
# Room of a label of a tip, wide and high, in radii of the hand.
_LABEL = (0.5, 0.14)
# In the list of a finger's names: it is left out.
_NONE = "none"
# In the list of fingers to bend.
_ALL = "all fingers"
# Turns of the palm by the names of their buttons; a quarter turn's axis is given.
_TURNS: dict[str, Turn] = {"turn": "dorsal", "distal": "distal", "quarter": "x"}
# Step of the joints [rad or m].
_STEP = 0.001


@dataclass(frozen=True)
class HandsEdit:
    """Correct a hand's description in the browser: palm, side, fingers, tips and rest posture.

    Shows the hand, and gestures of the package's recording as they are mapped to it, with scores.
    Turn the palm's axes, name the fingers or leave some out, bend them the other way, drag tips,
    move the joints to where the hand rests. What you give is held, and the rest is found again: the
    side follows the turned axes, the axes follow another thumb. Where another thumb, side or palm
    has nearly as much evidence, or it is uncertain to which side a fist closes, choose one of two
    pictures. Of fingers with one joint each, say whether they are jaws. Save writes the hand.yaml,
    with comments. The hand of a URDF or MJCF file is described first, as by `handmap hands init`;
    of several hands the first one, and the pictures or a list of roots lead to the others.

    Examples:
        handmap hands edit my_hand/hand.yaml --open
        handmap hands edit my_hand.urdf --open
        handmap hands edit allegro_right --out mine.yaml

    Attributes:
        hand: Path of a hand.yaml, URDF or MJCF file, or name of a hand of the package.
        out: File to write.
        overwrite: Replace the file if it exists and is not HAND.
        host: Address to listen on. Everyone who can reach it can change the file, so keep it on
            this machine unless you trust the network.
        port: Port to listen on. The next free one is taken if it is in use.
        open: Open the browser.
    """

    hand: Positional[HandName]
    out: Annotated[
        Path | None, hinted("FILE.yaml", "(default: HAND, or its name with .yaml)")
    ] = None
    overwrite: bool = False
    host: str = "127.0.0.1"
    port: int = 8080
    open: bool = False

    def run(self) -> None:
        """Show the page until interrupted."""
        check_port("--port", self.port)
        given = Path(self.hand)
        out = self.out or given.with_suffix(".yaml")
        check_free(out, overwrite=self.overwrite or out == given)
        kind = given.suffix.lower()
        remark = ""
        if kind in ROBOT_FILES or (given.is_file() and kind not in (".yaml", ".yml")):
            source = open_source(given)
            found = edit.described(first_hand(source.urdf), source)
        else:
            opened, remark = loadable(given)
            found = edit.open_description(opened)
        with showing(self.host, self.port, opens=self.open) as server:
            run_frames(HandEditor(server, found, out, remark).tick)


class _Page(NamedTuple):
    """What a page is made for.

    Attributes:
        joints: Names of the hand's joints.
        tips: Links of its fingertips.
        root: Link at which it begins.
        links: Links that it moves, which are drawn.
    """

    joints: Names
    tips: set[str]
    root: str | None
    links: Names


class HandEditor:
    """The page of a description, `found`, which Save writes to the file `out`.

    It begins with a `remark` on what was wrong in the file, if anything was.

    viser calls callbacks in threads of its own: they record what `tick` carries out, or ask first.
    Mapping, and finding a hand from another root, are done in the background meanwhile.
    """

    def __init__(
        self, server: ViserServer, found: Detection, out: Path, remark: str = ""
    ) -> None:
        self.out = out
        self._server = server
        self._gui = server.gui
        self._requests: list[tuple[str, Any]] = []
        self._search = Background[Detection]()
        # What the user has given: it is not derived again.
        self._held = Held()
        # Number of the pair of hands to choose from; None without a question.
        self._question = first_question(found)
        self._take(found)
        self._roots = _roots(self.hand)
        server.gui.reset()
        self._add_controls()
        self._build()
        say(self.message, remark)

    # -- the page

    def _add_controls(self) -> None:
        """Add controls, fingers and joints on the left, room for gestures on the right.

        Their buttons stay as long as the page: viser drops clicks on a control that was removed.
        """
        gui = self._gui
        gui.main_panel.dock_left()
        panel = gui.add_panel()
        tab = panel.add_tab("Gestures")
        panel.dock_right()
        controls = add_controls(gui, "editing", self._press)
        self.message = controls.message
        self.status = controls.status
        self.gestures = GestureTab(gui, tab, self.status, self._press)
        self.names: dict[str, Any] = {}
        self._fingers = gui.add_folder("fingers")
        with self._fingers:
            (self._naming,) = add_controls(gui, "naming", self._press)
            self.bent = gui.add_dropdown("bend", [_ALL])
            add_controls(gui, "bending", self._press)
        with gui.add_folder("root and palm", expand_by_default=False):
            self.palm = gui.add_dropdown("palm", [self.found.spec.palm.link])
            self.root = gui.add_dropdown("root", self._roots)
            add_controls(gui, "placing", self._press)
        self._kinds = gui.add_folder("fingers or jaws", visible=False)
        with self._kinds:
            self.kind = gui.add_dropdown("fingers with one joint", get_args(FingerKind))
            add_controls(gui, "kinds", self._press)
        self.joints: list[Any] = []
        self._sliders = gui.add_folder("joints")

    def _build(self) -> None:
        """Make the page of the hand: another hand has other joints and fingers."""
        self._page = _page_of(self.hand)
        spec = self.found.spec
        self._server.scene.reset()
        self._named: dict[str, str] = {}
        self._spare = left_out(spec)
        self._list_fingers()
        self.palm.options = palm_links(self.hand)
        root = spec.root or self._roots[0]
        self.root.options = [*dict.fromkeys([*self._roots, root])]
        self.root.value = root
        self._add_sliders()
        self._scene = HandScene(self._server, None, [self._shown(self.hand.rest)])
        self._add_handles(self._server.scene)
        self._show()

    def _list_fingers(self) -> None:
        """Add a list of names for each fingertip; those of tips that stay are kept."""
        tips = all_tips(self.hand)
        links = [*(tip.link for tip in tips.values()), *self._spare]
        options = [*dict.fromkeys([*FINGERS, *tips, _NONE])]
        for link in self.names.keys() - {*links}:
            self.names.pop(link).remove()
        boxes = dict[str, Any]()
        for link in links:
            box = self.names.get(link)
            if box is None:
                with self._fingers:
                    box = self._gui.add_dropdown(link, options, initial_value=_NONE)
            box.options = options
            if link in self._spare:
                box.value = _NONE
            # The button that applies the names comes last.
            box.order = self._naming.order - 1.0 + len(boxes) / len(links)
            boxes[link] = box
        self.names = boxes
        self._list_bent()

    def _list_bent(self) -> None:
        """Offer the fingers that there are now to be bent the other way."""
        options = [_ALL, *finger_tips(self.hand)]
        if [*self.bent.options] != options:
            self.bent.options = options
            self.bent.value = _ALL

    def _add_sliders(self) -> None:
        """Add a slider for each joint, in the place of those of another hand."""
        hand = self.hand
        self._rest = hand.rest
        for slider in self.joints:
            slider.remove()
        ranges = np.vstack([hand.limits, hand.rest]).T.tolist()
        with self._sliders:
            self.joints = [
                self._gui.add_slider(name, low, high, _STEP, rest)
                for name, (low, high, rest) in zip(
                    hand.joint_names, ranges, strict=True
                )
            ]

    def _add_handles(self, scene: Any) -> None:
        """Add the palm's axes with rings to turn them, and a name and arrows at each tip."""
        (figure,) = self._scene.robots
        size = figure.radius
        self._palm = scene.add_frame(
            "/robot/palm",
            axes_length=_AXES * size,
            axes_radius=_AXIS * size,
        )
        self.rings = scene.add_transform_controls(
            "/robot/rings",
            _RINGS * size,
            disable_axes=True,
            disable_sliders=True,
            depth_test=False,
            opacity=0.6,
        )
        self.rings.on_update(
            lambda event: event.phase == "end" and self._press("axes", None)
        )
        self.arrows = {}
        self._labels = {}
        for link, node in figure.links.items():
            node.on_click(lambda event, at=link: self._ask(at, event.client.gui))
        for tip in self.hand.reference_points:
            link = tip.link
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
        """Record a request, and what it is about: a browser, an axis, or a tip's link."""
        self._requests.append((name, which))

    # -- requests

    def tick(self, _: float = 0.0) -> None:
        """Carry out the user's requests, map the gestures in the background, and draw."""
        if self._search.is_busy:
            self._take_search()
        while self._requests and not self._search.is_busy:
            request, which = self._requests.pop(0)
            with reporting(self.message, ""):
                self._act(request, which)
            if not self._search.is_busy:
                self._show()
        self.gestures.update(self.found, self._question)
        self._draw()

    def _take_search(self) -> None:
        """Take the hand that was looked for, if it has been found."""
        outcome = self._search.take()
        if outcome is None:
            return
        if isinstance(outcome, HandmapError):
            say(self.message, outcome)
            self.root.value = self.found.spec.root or self._roots[0]
            return
        self._held = Held()
        say(self.message, None)
        self._take(outcome)
        self._show()

    def _act(self, request: str, which: Any) -> None:
        """Carry out a request."""
        hand = self.hand
        match request:
            case "save":
                write_hand(self.found, self.out)
                which.add_notification("Saved", f"wrote {self.out}")
                return
            case "palms":
                self._question = 0
                return
            case "neither":
                self._question = (self._question or 0) + 1
                return
            case "root":
                self._look_from(self.root.value)
                return
            case "kind":
                self._look_from(self.found.spec.root, self.kind.value)
                return
            case "left" | "right":
                self._choose(request)
                return
        if request in (*_TURNS, "axes"):
            self._held = self._held._replace(axes=True)
        if request in _TURNS:
            turn: Turn = which if request == "quarter" else _TURNS[request]
            spec = with_turn(hand, turn, self._held)
        else:
            spec = self._corrected(request, which)
        self._take(edit.corrected(self.found, spec))

    def _choose(self, which: str) -> None:
        """Take the hand of the picture that was chosen, and ask what is uncertain then."""
        asked = self.gestures.question
        if asked is None:
            return
        chosen = asked.choices[which == "right"]
        self._take(chosen)
        if asked.is_reading:
            self._held = Held()
            self._question = first_question(chosen)
        else:
            self._held = self._held._replace(axes=True)
            self._question = None

    def _corrected(self, request: str, which: Any) -> HandSpec:
        """Return the description with one correction."""
        hand = self.hand
        match request:
            case "axes":
                return self._with_rings(hand)
            case "side":
                self._held = self._held._replace(side=True)
                return edit.with_other_side(hand)
            case "rest":
                return edit.with_rest(hand, self._q)
            case "bend":
                chosen = self.bent.value
                names = [*finger_tips(hand)] if chosen == _ALL else [chosen]
                return edit.with_bend_reversed(hand, names)
            case "names":
                return self._with_names(
                    {link: _given(box.value) for link, box in self.names.items()}
                )
            case "name":
                return self._with_names(exchanged(hand, *which))
            case "tip":
                (pose,) = hand.link_poses([which], self._q)
                place = np.array(self.arrows[which].position)
                xyz = transform_points(inverse_pose(pose), place)
                return edit.with_tip(hand, self._labels[which].text, xyz)
            case "palm":
                return with_palm_link(hand, self.palm.value)
        raise AssertionError(request)

    def _with_rings(self, hand: Hand) -> HandSpec:
        """Return the description with the palm's axes as the rings show them."""
        (pose,) = hand.link_poses([hand.spec.palm.link], self._q)
        turn = rotation_from_quat_wxyz(np.array(self.rings.wxyz))
        axes = snapped_axes(pose[:3, :3].T @ turn)
        return with_palm_axes(hand, axes, self._held)

    def _with_names(self, names: dict[str, str | None]) -> HandSpec:
        """Return the description with these names; for another thumb the palm is found again."""
        hand = self.hand
        spec = with_names(hand, names)
        self._held = self._held._replace(names=True)
        before = all_tips(hand).get(THUMB)
        link = next((link for link, name in names.items() if name == THUMB), None)
        if before is None or link is None or link == before.link or self._held.axes:
            return spec
        side = hand.side if self._held.side else None
        return with_thumb(self.found._replace(spec=spec), link, side)

    def _look_from(self, root: str | None, kind: FingerKind | None = None) -> None:
        """Look for the hand from a link on, in the background; a thumb that is given stays.

        Args:
            root: The link; that of the URDF if None.
            kind: What fingers with one joint each are; found if omitted.
        """
        say(self.message, f"looking for the hand from {root or self._roots[0]} on …")
        found = self.found
        side = self.hand.side if self._held.side else None
        thumb = None
        if self._held.names and root == found.spec.root:
            thumb = _thumb_joint(self.hand)
        self._search.start(lambda: at_root(found, root, side, thumb, kind))

    def _ask(self, link: str, gui: Any) -> None:
        """Ask for the name of the finger that a link is of, if it is of one."""
        hand = self.hand
        joint = hand.model.names[hand.frames[link].parentJoint]
        if finger := finger_by_joint(hand).get(joint):
            with gui.add_modal(f"Name the finger that is called {finger}") as modal:
                names = gui.add_button_group("", FINGERS)

            @names.on_click
            def _(_: Any) -> None:
                self._press("name", (finger, names.value))
                modal.close()

    # -- the hand

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
        label = f"a {hand.side} hand"
        return Variant(label, hand, None, [sample], drawn=self._page.links)

    def _show(self) -> None:
        """Show fingers by their names, and the hand with its palm upright."""
        if _page_of(self.hand) != self._page:
            self._build()
            return
        named = {tip.link: name for name, tip in all_tips(self.hand).items()}
        for link, name in named.items():
            # Names that were chosen, and not applied yet, stay.
            if name != self._named.get(link):
                self.names[link].value = name
            if link in self._labels:
                self._labels[link].text = name
        self._named = named
        self._list_bent()
        # Joints that were moved stay, unless the hand rests elsewhere now.
        if not np.array_equal(self._rest, self.hand.rest):
            self._rest = self.hand.rest
            for slider, at in zip(self.joints, self._rest.tolist(), strict=True):
                slider.value = at
        self.palm.value = self.found.spec.palm.link
        self._kinds.visible = self.found.kind is not None
        self.kind.value = self.found.kind or self.kind.value
        self._scene.set_variants([self._shown(self.hand.rest)])
        self._drawn = None

    def _draw(self) -> None:
        """Draw the posture if it has changed."""
        q = self._q
        if q.tolist() != self._drawn:
            self._drawn = q.tolist()
            self._scene.draw(self._shown(q).samples)
            pose = self.hand.frame_pose("palm", q)
            place_node(self._palm, pose)
            place_node(self.rings, pose)
            tips = {
                tip.link: self.hand.frame_pose(tip.name, q)[:3, 3]
                for tip in self.hand.reference_points
            }
            for link, place in tips.items():
                self.arrows[link].position = place
            self._place_labels(np.array([*tips.values()]))
        self._scene.cameras.update()

    def _place_labels(self, tips: Array) -> None:
        """Move the labels of the tips (n, 3) apart, up and down in the view."""
        (figure,) = self._scene.robots
        seen = (tips @ figure.axes.T)[:, :2]
        places = spread_labels(seen, *(np.array(_LABEL) * figure.radius).tolist())
        ways = np.column_stack([places - seen, np.zeros(len(tips))]) @ figure.axes
        for label, way in zip(self._labels.values(), ways, strict=True):
            label.position = way


def _page_of(hand: Hand) -> _Page:
    tips = {tip.link for tip in all_tips(hand).values()}
    return _Page(hand.joint_names, tips, hand.spec.root, links_of_hand(hand))


def _thumb_joint(hand: Hand) -> str | None:
    """Return the joint that moves the thumb's tip, if there is a thumb."""
    tip = all_tips(hand).get(THUMB)
    return None if tip is None else hand.model.names[hand.frames[tip.link].parentJoint]


def _given(name: str) -> str | None:
    return None if name == _NONE else name


def _roots(hand: Hand) -> list[str]:
    """Return the links at which the hand can begin; its own if the URDF cannot be read."""
    spec = hand.spec
    try:
        return [*possible_roots(urdf_path(spec))]
    except HandError:
        return [spec.root or spec.palm.link]
