"""Physics of the simulation: momentum, friction, statics, couplings, determinism."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from arc import SoftSimulator, holding_forces, squeeze, stiffness_of, take_hold
from contact_forces import contacts
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from section_four.contacts import Contact, Grasp
from section_four.statics import quasistatic
from simulation_cases import CUBE, cube_grasp

from handmap_qp import InvalidInputError, InvalidOptionsError, load_hand
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.torques import torque_limits
from handmap_qp.mapping.objects import Box, Cylinder, MeshShape, Sphere
from handmap_qp.se3 import affine

MASS = 0.1
WEIGHT = np.array([0.0, 0.0, -9.81 * MASS, 0.0, 0.0, 0.0])
FAR = affine(np.eye(3), np.array([0.0, 0.0, 2.0]))


# Each soft synergy bends two fingers.
SYNERGIES = np.zeros((8, 2))
SYNERGIES[[0, 3], 0], SYNERGIES[[1, 6], 1] = (1.0, 0.6), (0.7, 0.8)
SOFT = SYNERGIES @ SYNERGIES.T / 2.0
KINDS = pytest.mark.parametrize("compliance", [None, SOFT], ids=["servos", "soft"])


def velocity_of_object(simulator: Simulator) -> np.ndarray:
    """Return the velocity of the object's centre, world axes [m/s], shape (3,)."""
    v, model = np.zeros(6), simulator.model
    kind, body = mujoco.mjtObj.mjOBJ_BODY, model.body("/object").id
    mujoco.mj_objectVelocity(model, simulator.data, kind, body, v, 0)
    return v[3:]


def torques_of(simulator: Simulator) -> np.ndarray:
    """Return the torques of the actuators [N m], shape (n,)."""
    model = simulator.model
    names = simulator.hand.joint_names
    return simulator.data.qfrc_actuator[[model.joint(n).dofadr[0] for n in names]]


def simulate(
    hand: Hand, physics: Physics, compliance: np.ndarray | None = None
) -> Simulator:
    """The cube and a hand, whose motors may have springs in series."""
    physics = physics.replaced(mass=MASS)
    if compliance is None:
        return Simulator(hand, CUBE, physics)
    return SoftSimulator(hand, CUBE, physics, compliance)


def posed(simulator: Simulator, q: np.ndarray, wrist: np.ndarray | None) -> np.ndarray:
    """Return the configuration of the hand at joint angles and a wrist pose."""
    return simulator.hand.configuration_vector(q, wrist)


def held(
    physics: Physics, normal_force: float = 6.0, compliance: np.ndarray | None = None
) -> tuple[Simulator, Grasp, np.ndarray]:
    """The cube in the hand, with its weight."""
    grasp = cube_grasp()
    load = MASS * np.array([*physics.gravity, 0.0, 0.0, 0.0])
    forces = holding_forces(grasp, load, normal_force)
    simulator = simulate(grasp.hand, physics, compliance)
    offset = squeeze(grasp, forces, stiffness_of(simulator))
    take_hold(simulator, grasp, offset)
    return simulator, grasp, offset


@pytest.mark.parametrize(
    "shape",
    [
        CUBE,
        Sphere(0.03),
        Cylinder(0.02, 0.08),
        MeshShape(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]) - 0.025),
    ],
    ids=lambda shape: type(shape).__name__,
)
def test_a_free_object_falls_as_galileo_said(
    shape: Box | Sphere | Cylinder | MeshShape,
) -> None:
    grasp = cube_grasp()
    simulator = Simulator(grasp.hand, shape, Physics(mass=MASS))
    simulator.reset(posed(simulator, grasp.q, grasp.wrist_pose), FAR)
    simulator.follow(simulator.target, 0.3)
    step, time = simulator.physics.time_step, simulator.time
    fallen = 2.0 - simulator.object_pose[2, 3]
    # The semi-implicit scheme falls half a step's speed farther than g t^2 / 2.
    assert fallen == pytest.approx(0.5 * 9.81 * time * (time + step), abs=1e-9)
    assert velocity_of_object(simulator)[2] == pytest.approx(-9.81 * time, abs=1e-9)


def test_forces_on_the_object_are_its_weight_once_it_rests() -> None:
    simulator, _, _ = held(Physics(torsion=0.0))
    simulator.follow(simulator.target, 0.5)
    touching = contacts(simulator)
    np.testing.assert_allclose(touching.forces.sum(axis=0), -WEIGHT[:3], atol=2e-3)
    arms = touching.points - simulator.object_pose[:3, 3]
    np.testing.assert_allclose(
        np.cross(arms, touching.forces).sum(axis=0), 0.0, atol=2e-4
    )


def test_momentum_changes_by_the_impulse_of_contacts_and_gravity() -> None:
    """Tilted and carried: m dv = (sum f + m g) dt, summed over every step."""
    simulator, _, _ = held(Physics(friction=1.2))
    model, data, dt = simulator.model, simulator.data, simulator.physics.time_step
    before, impulse = velocity_of_object(simulator), np.zeros(3)
    for k in range(60):
        data.mocap_pos[0] += (4e-6 * k, 0.0, 2e-6 * k)
        mujoco.mj_step(model, data)
        # The forces with which MuJoCo made this step.
        impulse += (contacts(simulator).forces.sum(axis=0) + WEIGHT[:3]) * dt
    mujoco.mj_forward(model, data)
    gained = MASS * (velocity_of_object(simulator) - before)
    assert np.linalg.norm(gained) > 5e-3
    np.testing.assert_allclose(gained, impulse, atol=1e-6)


@settings(max_examples=4)
@given(st.floats(0.3, 1.5), st.floats(2.0, 10.0))
def test_contact_forces_stay_in_their_friction_cones(
    friction: float, force: float
) -> None:
    simulator, grasp, offset = held(Physics(friction=friction, torsion=0.0), force)
    assert grasp.wrist_pose is not None
    target = grasp.wrist_pose.copy()
    target[0, 3] += 0.02
    for _ in range(10):
        simulator.follow(posed(simulator, grasp.q + offset, target), 0.02)
        touching = contacts(simulator)
        normal = touching.normal_forces
        tangential = np.linalg.norm(
            touching.forces - normal[:, None] * touching.normals, axis=1
        )
        assert (normal >= -1e-9).all()
        assert (tangential <= friction * normal * (1.0 + 1e-6) + 1e-9).all()


def test_too_little_friction_drops_the_object_and_enough_holds_it() -> None:
    """Around the friction that the planned forces use, in the direction that uses most."""
    grasp = cube_grasp()
    directions = [sign * axis for axis in np.eye(3) for sign in (-9.81, 9.81)]
    uses = []
    for g in directions:
        forces = holding_forces(grasp, MASS * np.array([*g, 0, 0, 0]), 1.5)
        normal = np.einsum("ci,ci->c", forces, grasp.normals)
        assert (normal > 0.0).all()
        tangential = np.linalg.norm(forces - normal[:, None] * grasp.normals, axis=1)
        uses.append((tangential / normal).max())
    gravity = directions[int(np.argmax(uses))]
    moved = {}
    for share in (0.02, 2.0):
        physics = Physics(
            friction=float(share * max(uses)),
            torsion=0.0,
            gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
        )
        simulator, _, _ = held(physics, 1.5)
        simulator.follow(simulator.target, 0.6)
        moved[share] = np.linalg.norm(grasp.centre - simulator.object_pose[:3, 3])
    assert moved[0.02] > 0.01
    assert moved[2.0] < 3e-3


@KINDS
def test_planned_forces_balance_the_load_and_are_found_in_the_simulation(
    compliance: np.ndarray | None,
) -> None:
    physics = Physics(gravity=(0.0, 0.0, 0.0), torsion=0.0, friction=1.5)
    grasp = cube_grasp()
    forces = holding_forces(grasp, np.zeros(6), 6.0)
    np.testing.assert_allclose(grasp.matrix @ forces.ravel(), 0.0, atol=1e-9)
    simulator, _, _ = held(physics, compliance=compliance)
    found = contacts(simulator).forces
    assert len(found) == len(forces)
    command = simulator.instant().command
    torques = stiffness_of(simulator) @ (command - simulator.q)
    np.testing.assert_allclose(torques_of(simulator), torques, atol=2e-3)
    nearest = [np.linalg.norm(found - force, axis=1).min() for force in forces]
    assert max(nearest) < 0.05 * np.linalg.norm(forces, axis=1).max()


def test_soft_synergies_are_springs_in_series() -> None:
    """Both equations of the model, solved for the torques by hand."""
    hand = cube_grasp().hand
    drive = SoftSimulator(hand, CUBE, Physics(), SOFT)
    q, reference = np.linspace(-0.2, 0.3, 8), np.array([0.4, -0.1])
    torques = drive.torques(SYNERGIES @ reference, q, np.zeros(8))
    synergy = reference - SYNERGIES.T @ torques / 2.0
    np.testing.assert_allclose(torques, 3.0 * (SYNERGIES @ synergy - q), atol=1e-12)
    # Critical damping of every mode: D M^-1 D = 4 K for one inertia M.
    inertia = drive.damping @ np.linalg.inv(drive.stiffness) @ drive.damping / 4.0
    np.testing.assert_allclose(inertia, np.diag(np.diag(inertia)), atol=1e-9)
    with pytest.raises(InvalidInputError, match="compliance"):
        SoftSimulator(hand, CUBE, Physics(), np.eye(3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compliance", "synergies", "stiffness"),
    [
        (None, np.eye(8)[:, [0, 1, 3, 6]], np.inf),
        (SOFT, SYNERGIES, 2.0),
    ],
    ids=["servos", "soft"],
)
def test_slow_motion_changes_forces_and_object_as_the_statics_predict(
    compliance: np.ndarray | None,
    synergies: np.ndarray,
    stiffness: float,
) -> None:
    """Eq. of the paper's [22] with rigid contacts, against MuJoCo's own dynamics."""
    physics = Physics(
        gravity=(0.0, 0.0, 0.0),
        torsion=0.0,
        friction=2.0,
        time_step=1e-3,
        contact_time=2e-3,
    )
    simulator, grasp, offset = held(physics, compliance=compliance)
    simulator.follow(simulator.target, 1.0)
    start, q, pose = contacts(simulator), simulator.q, simulator.object_pose
    links = [name.replace("f", "finger", 1) for name in start.bodies]
    frames = grasp.hand.link_poses(links, q, simulator.wrist)
    on_links = tuple(
        Contact(link, tuple(f[:3, :3].T @ (p - f[:3, 3])), tuple(f[:3, :3].T @ n))
        for link, f, p, n in zip(
            links, frames, start.points, start.normals, strict=True
        )
    )
    now = Grasp(grasp.hand, q, pose, on_links, simulator.wrist)
    predicted = quasistatic(
        now.jacobian,
        now.matrix,
        synergies,
        contact_stiffness=1e5,
        joint_stiffness=physics.joint_stiffness,
        synergy_stiffness=stiffness,
    )
    for column, change in enumerate(0.01 * synergies.T):
        base, rest = simulator.object_pose[:3, 3], contacts(simulator).forces
        simulator.follow(
            posed(simulator, grasp.q + offset + change, grasp.wrist_pose),
            0.5,
        )
        simulator.follow(simulator.target, 0.2)
        forces = (contacts(simulator).forces - rest).ravel()
        wanted = 0.01 * predicted.contact_forces[:, column]
        cosine = forces @ wanted / np.linalg.norm(forces) / np.linalg.norm(wanted)
        assert cosine > 0.95, column
        assert np.linalg.norm(forces) == pytest.approx(
            np.linalg.norm(wanted), rel=0.25
        ), column
        moved = simulator.object_pose[:3, 3] - base
        error = np.linalg.norm(moved - 0.01 * predicted.object_motion[:3, column])
        assert error < 1e-4, column
        simulator.follow(posed(simulator, grasp.q + offset, grasp.wrist_pose), 0.3)


def test_the_same_commands_give_the_same_motion() -> None:
    poses = []
    for _ in range(2):
        simulator, grasp, offset = held(Physics())
        simulator.follow(
            posed(simulator, grasp.q + 0.5 * offset, grasp.wrist_pose),
            0.2,
        )
        poses.append(np.concatenate([simulator.data.qpos, simulator.data.qvel]))
    np.testing.assert_array_equal(poses[0], poses[1])


def test_the_simulation_keeps_the_time_of_its_commands() -> None:
    """Samples of 115 Hz are no whole steps of 2 ms, and those of 1 kHz less than one."""
    grasp = cube_grasp()
    simulator = Simulator(grasp.hand, CUBE)
    for _ in range(2):
        simulator.reset(posed(simulator, grasp.q, grasp.wrist_pose), FAR)
        for k in range(1, 116):
            simulator.follow(
                posed(simulator, grasp.q, grasp.wrist_pose),
                1.0 / 115.0,
            )
            assert simulator.time == pytest.approx(k / 115.0, abs=1.01e-3)


def test_torques_are_those_of_the_maker_at_most() -> None:
    """The URDF's limits, and the physics' where they are less; a limit of 0 stands for none."""
    hand = load_hand("three_finger")
    text = hand.urdf_text.replace('effort="5"', 'effort="0.05"', 1)
    assert text != hand.urdf_text
    weak = Hand(hand.spec, urdf_text=text)
    for limit, wanted in ((1e3, {0.05, 5.0}), (0.4, {0.05, 0.4})):
        simulator = Simulator(weak, CUBE, Physics(torque=limit))
        bounds = simulator.model.actuator_forcerange
        np.testing.assert_array_equal(bounds[:, 0], -bounds[:, 1])
        assert set(bounds[:, 1]) == wanted
    simulator.reset(posed(simulator, hand.rest, np.eye(4)), FAR)
    simulator.follow(posed(simulator, hand.upper_limits, np.eye(4)), 0.02)
    torque = np.abs(simulator.instant().torque)
    assert torque.max() == pytest.approx(0.4)
    assert torque[bounds[:, 1] == 0.05] == pytest.approx(0.05)
    romeo = Simulator(load_hand("romeo_left"), CUBE, Physics(torque=0.7))
    assert romeo.model.actuator_forcerange[0, 1] == 0.7
    # Arms have those of their URDF alone.
    arm = load_hand("g1_arm_left")
    bounds = Simulator(arm, CUBE, Physics(torque=0.1)).model.actuator_forcerange
    efforts = arm.model.effortLimit[arm.v_indices]
    wanted = np.where(arm.moves_wrist, efforts, np.minimum(efforts, 0.1))
    np.testing.assert_array_equal(bounds[:, 1], wanted)


def test_the_clearance_is_the_distance_of_the_nearest_link() -> None:
    grasp = cube_grasp()
    simulator = Simulator(grasp.hand, Sphere(0.02))
    simulator.reset(
        posed(simulator, grasp.q, np.eye(4)),
        affine(np.eye(3), (0.0, 0.0, -0.3)),
    )
    far = simulator.clearance()
    simulator.reset(
        posed(simulator, grasp.q, np.eye(4)),
        affine(np.eye(3), (0.0, 0.0, -0.2)),
    )
    assert far - simulator.clearance() == pytest.approx(0.1, abs=0.02)
    body = simulator.hand.model.names[-1]
    tip = simulator.body_pose(body)[:3, 3]
    assert simulator.clearance() <= simulator.clearance([body])
    simulator.reset(posed(simulator, grasp.q, np.eye(4)), affine(np.eye(3), tip))
    assert simulator.clearance([body]) < 0.0
    assert simulator.clearance() <= simulator.clearance([body])


def test_a_stand_holds_the_object_until_it_lets_go() -> None:
    grasp = cube_grasp()
    pose = FAR.copy()
    pose[:3, :3] = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    simulator = Simulator(grasp.hand, CUBE, Physics(mass=0.3))
    simulator.reset(posed(simulator, grasp.q, grasp.wrist_pose), pose)
    simulator.set_stand(holds=True)
    simulator.follow(simulator.target, 0.3)
    np.testing.assert_allclose(simulator.object_pose, pose, atol=1e-3)
    simulator.set_stand(holds=False)
    simulator.follow(simulator.target, 0.3)
    assert simulator.object_pose[2, 3] < 1.7


@pytest.mark.parametrize("push", [0.9, 1.5])
def test_an_object_slides_on_its_stand_by_coulombs_law(push: float) -> None:
    """A push of `push` times mu m g moves it by (push - 1) mu g t^2 / 2, or not at all."""
    grasp, physics = cube_grasp(), Physics(friction=0.5)
    simulator = Simulator(grasp.hand, CUBE, physics.replaced(mass=0.3))
    simulator.reset(posed(simulator, grasp.q, grasp.wrist_pose), FAR)
    simulator.set_stand(holds=True)
    weight = 0.3 * np.linalg.norm(physics.gravity)
    held_body = simulator.model.body("/object").id
    simulator.data.xfrc_applied[held_body, 0] = push * 0.5 * weight
    simulator.follow(simulator.target, 0.2)
    moved = simulator.object_pose[:3, 3] - FAR[:3, 3]
    free = max(0.0, push - 1.0) * 0.5 * np.linalg.norm(physics.gravity) * 0.2**2 / 2.0
    # One step of 2 ms is 1 % of 0.2 s.
    np.testing.assert_allclose(moved, [free, 0.0, 0.0], rtol=0.0101, atol=1e-8)


@KINDS
def test_the_wrist_follows_its_command_and_a_free_hand_does_not_fall(
    compliance: np.ndarray | None,
) -> None:
    grasp = cube_grasp()
    assert grasp.wrist_pose is not None
    simulator = simulate(grasp.hand, Physics(), compliance)
    simulator.reset(posed(simulator, grasp.q, grasp.wrist_pose), FAR)
    np.testing.assert_allclose(simulator.wrist, grasp.wrist_pose, atol=1e-12)
    target = grasp.wrist_pose.copy()
    target[:3, 3] += 0.1
    simulator.follow(posed(simulator, grasp.q, target), 0.5)
    simulator.follow(simulator.target, 0.3)
    np.testing.assert_allclose(simulator.wrist, target, atol=1e-3)
    np.testing.assert_allclose(simulator.q, grasp.q, atol=1e-3)
    # The hand's own weight is compensated beside the actuators.
    assert np.abs(torques_of(simulator)).max() < 2e-3


def test_mimic_joints_follow_their_leaders() -> None:
    """One motor bends all fingers of Romeo's hand."""
    hand = load_hand("romeo_left")
    simulator = Simulator(hand, CUBE, Physics(mass=MASS))
    simulator.reset(posed(simulator, hand.rest, np.eye(4)), FAR)
    q = hand.rest + 0.2 * (hand.upper_limits - hand.rest)
    simulator.follow(posed(simulator, q, np.eye(4)), 0.4)
    simulator.follow(simulator.target, 0.4)
    wanted = dict(zip(hand.all_joint_names, hand.all_joints(simulator.q), strict=True))
    roles = zip(hand.all_joint_names, hand.all_joint_roles, strict=True)
    moving = [name for name, role in roles if role != "locked"]
    assert len(moving) > len(hand.joint_names)
    found = [simulator.data.joint(name).qpos[0] for name in moving]
    np.testing.assert_allclose(found, [wanted[name] for name in moving], atol=0.02)


@pytest.mark.parametrize(
    "name", ["three_finger", "hey5", "allegro_left", "g1_arm_left"]
)
def test_bodies_are_where_pinocchio_has_them(name: str) -> None:
    """At random postures; a hand on an arm has a fixed root."""
    hand = load_hand(name)
    simulator = Simulator(hand, CUBE)
    random = np.random.default_rng(0)
    q = random.uniform(hand.lower_limits, hand.upper_limits)
    wrist = None
    if hand.is_floating:
        turn = Rotation.random(random_state=1).as_matrix()
        wrist = affine(turn, np.array([0.1, 0.2, 0.3]))
    simulator.reset(posed(simulator, q, wrist), FAR)
    np.testing.assert_allclose(simulator.q, q, atol=1e-12)
    wanted = hand.frame_pose("wrist", q, wrist)
    np.testing.assert_allclose(simulator.wrist, wanted, atol=1e-12)
    for joint in hand.model.names[2 if hand.is_floating else 1 :]:
        body = simulator.data.body(joint)
        pose = affine(body.xmat.reshape(3, 3), body.xpos)
        np.testing.assert_allclose(pose, hand.frame_pose(joint, q, wrist), atol=1e-12)


def test_links_without_mass_have_that_of_their_shapes() -> None:
    hand = load_hand("three_finger")
    text = re.sub(r"<inertial>.*?</inertial>", "", hand.urdf_text, flags=re.DOTALL)
    light = Hand(hand.spec, urdf_text=text)
    masses = [
        Simulator(light, CUBE, Physics(density=density)).model.body_mass
        for density in (500.0, 1000.0)
    ]
    fingers = masses[0] != masses[1]
    assert fingers.sum() >= 6
    np.testing.assert_allclose(masses[1][fingers], 2.0 * masses[0][fingers])


@pytest.mark.parametrize(
    "change",
    [
        {"friction": -0.1},
        {"joint_stiffness": 0.0},
        {"sliding_stiffness": 0.0},
        {"time_step": float("nan")},
        {"gravity": (0.0, 0.0, float("inf"))},
        {"contact_time": 1e-3},
        {"density": "heavy"},
        {"torque": 0.0},
        {"armature": float("inf")},
        {"mass": 0.0},
    ],
    ids=str,
)
def test_impossible_physics_is_refused(change: dict) -> None:
    with pytest.raises(InvalidOptionsError) as caught:
        Physics(**change)
    assert caught.value.option == next(iter(change))


def test_impossible_bodies_and_starts_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="points"):
        MeshShape(np.zeros((4, 3)))
    grasp = cube_grasp()
    simulator = Simulator(grasp.hand, CUBE, Physics(mass=MASS))
    with pytest.raises(InvalidInputError, match="wrist"):
        simulator.reset(posed(simulator, grasp.q, np.zeros((4, 4))), FAR)
    with pytest.raises(InvalidInputError, match="q"):
        simulator.reset(posed(simulator, grasp.q[1:], grasp.wrist_pose), FAR)
    with pytest.raises(InvalidInputError, match="three contacts"):
        holding_forces(
            Grasp(
                grasp.hand,
                grasp.q,
                grasp.object_pose,
                grasp.contacts[:2],
                grasp.wrist_pose,
            ),
            WEIGHT,
            1.0,
        )


def test_a_further_hand_follows_its_own_commands_and_leaves_the_first_alone() -> None:
    """Two hands of a family in one model: each is where it is commanded, and moves by itself."""
    right, left = load_hand("allegro_right"), load_hand("allegro_left")
    away = affine(np.eye(3), np.array([0.5, 0.0, 0.3]))
    goal = right.configuration_vector(right.rest * 0.5 + 0.1)
    end = left.configuration_vector(left.rest * 0.5 + 0.2, away)
    places = []
    for others, ends in (({}, {}), ({"/other/": left}, {"/other/": end})):
        simulator = Simulator(right, CUBE, Physics(), others=others)
        simulator.reset(goal, FAR, ends)
        simulator.follow(goal, 0.5, ends)
        places.append((simulator.q, simulator.wrist))
        assert len(simulator.instant().torque) == len(right.joint_names)
    assert np.allclose(places[0][0], places[1][0], atol=1e-9)
    assert np.allclose(places[0][1], places[1][1], atol=1e-9)
    assert np.allclose(simulator.wrist_of("/other/"), away, atol=1e-3)
    q = [simulator.data.joint(f"/other/{n}").qpos[0] for n in left.joint_names]
    assert np.allclose(q, end[left.q_indices], atol=1e-3)


def test_each_of_two_hands_has_the_torques_of_its_own_motors() -> None:
    first, further = load_hand("allegro_right"), load_hand("ability_right")
    simulator = Simulator(first, CUBE, Physics(), others={"/other/": further})
    for hand, prefix in ((first, ""), (further, "/other/")):
        found = [
            simulator.model.actuator(prefix + name).forcerange[1]
            for name in hand.joint_names
        ]
        np.testing.assert_array_equal(found, torque_limits(hand).values)
