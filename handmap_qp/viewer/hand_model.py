"""A hand's links as a tree of nodes in the scene: `LinkTree` and `HandModel`.

The poses are those of the hand's own kinematics. Only joints that move are sent to the browser.
"""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.drawing.hands import mesh_file
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf import parse_urdf
from handmap_qp.viewer.merged_shapes import merge_shapes

if TYPE_CHECKING:
    import viser

# Smaller changes of a quaternion, or of a position [m], are not sent.
_STILL = 1e-6


class LinkTree:
    """Links, their parents and their shapes.

    Args:
        hand: The hand.

    Attributes:
        root: Root link.
        moving: Links whose joint can move, parents first.
        fixed: The other links but the root, parents first.
        paths: For each link, the names of its ancestors and its own, joined by slashes.
        shapes: For each link with shapes, their poses (4, 4) in its frame and their meshes.
    """

    def __init__(self, hand: Hand) -> None:
        urdf = _load_urdf(hand)
        self._hand = hand
        self.root: str = urdf.base_link
        parents = {joint.child: joint.parent for joint in urdf.joint_map.values()}
        self.paths = {self.root: self.root}
        while len(self.paths) <= len(parents):
            self.paths |= {
                child: f"{self.paths[parent]}/{child}"
                for child, parent in parents.items()
                if parent in self.paths
            }
        can_move = {joint.child for joint in urdf.joint_map.values() if joint.type != "fixed"}
        self.moving = [link for link in self.paths if link in can_move]
        self.fixed = [link for link in self.paths if link in parents and link not in can_move]
        self._parents = parents
        self.shapes: dict[str, list[tuple[np.ndarray, Any]]] = {}
        scene = urdf.scene
        for node in scene.graph.nodes_geometry:
            link = scene.graph.transforms.parents[node]
            mesh = scene.geometry[scene.graph.get(node)[1]]
            self.shapes.setdefault(link, []).append((scene.graph.get(node, link)[0], mesh))

    def relative(
        self, links: list[str], q: np.ndarray, wrist: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses of links in the frames of their parents.

        Args:
            links: The links; not the root.
            q: Joint angles [rad], shape (n_joints,).
            wrist: Wrist pose, shape (4, 4); None for a hand that does not float.

        Returns:
            Rotations as quaternions (w, x, y, z), shape (n, 4), and positions [m], shape (n, 3).
        """
        if not links:
            return np.empty((0, 4)), np.empty((0, 3))
        both = [*links, *(self._parents[link] for link in links)]
        poses = np.array(self._hand.link_poses(both, q, wrist))
        own, parent = poses[: len(links)], poses[len(links) :]
        turn = parent[:, :3, :3].transpose(0, 2, 1)
        shift = (turn @ (own[:, :3, 3] - parent[:, :3, 3])[:, :, None])[:, :, 0]
        quats = Rotation.from_matrix(turn @ own[:, :3, :3]).as_quat(scalar_first=True)
        return quats, shift


class HandModel:
    """A hand's meshes in the scene.

    Args:
        server: A running viser server.
        path: Name of the parent node, whose pose is that of the root link.
        hand: The hand.

    Attributes:
        tree: Its links.
    """

    def __init__(self, server: viser.ViserServer, path: str, hand: Hand) -> None:
        self.tree = tree = LinkTree(hand)
        wrist = np.eye(4) if hand.is_floating else None
        places = {}
        for links in (tree.fixed, tree.moving):
            quats, shifts = tree.relative(links, hand.rest, wrist)
            places |= {link: pose for link, *pose in zip(links, quats, shifts, strict=True)}
        self._nodes = {}
        for link, name in tree.paths.items():
            quat, shift = places.get(link, (np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)))
            self._nodes[link] = server.scene.add_frame(
                f"{path}/{name}", show_axes=False, wxyz=quat, position=shift
            )
            for i, (pose, mesh) in enumerate(tree.shapes.get(link, ())):
                server.scene.add_mesh_trimesh(
                    f"{path}/{name}/{link}_shape_{i}", mesh.copy().apply_transform(pose)
                )
        self._moving = [self._nodes[link] for link in tree.moving]
        self._quats, self._shifts = tree.relative(tree.moving, hand.rest, wrist)

    def show(self, q: np.ndarray, wrist: np.ndarray | None) -> None:
        """Move the links to a posture.

        Args:
            q: Joint angles [rad], shape (n_joints,).
            wrist: Wrist pose, shape (4, 4); None for a hand that does not float.
        """
        quats, shifts = self.tree.relative(self.tree.moving, q, wrist)
        turned = np.abs(quats - self._quats).max(axis=1) > _STILL
        moved = np.abs(shifts - self._shifts).max(axis=1) > _STILL
        for i in np.flatnonzero(turned):
            self._moving[i].wxyz = self._quats[i] = quats[i]
        for i in np.flatnonzero(moved):
            self._moving[i].position = self._shifts[i] = shifts[i]


def _load_urdf(hand: Hand) -> Any:
    """Load the hand's URDF with its meshes, one for each link."""
    from yourdfpy import URDF

    robot = parse_urdf(hand.urdf_text)
    # yourdfpy names the nodes of links and of shapes alike, and a shape with a link's name would
    # replace the link: rename all shapes.
    for link in robot.iterfind("link"):
        for i, visual in enumerate(link.iterfind("visual")):
            visual.set("name", f"{link.get('name')}_shape_{i}")
    text = io.BytesIO(ET.tostring(robot))
    urdf = URDF.load(text, filename_handler=lambda fname: str(mesh_file(fname, hand.spec)))
    merge_shapes(urdf)
    return urdf
