"""Holds and summary numbers of a mapped motion, printed by `handmap retarget`."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np

from handmap_core.se3 import Array, lengths
from handmap_qp.hands import Hand, Values
from handmap_qp.human import Recording
from handmap_qp.mapping import ASSUMED_SHARE, arm_held_by, assumed_joints, fist_time
from .closings import closing_times
from .leaning import measure_leaning
from .trajectory import RobotMotion, Trajectory, stretches

SLOW_SHARE = 0.2
"""Share of samples held by a speed limit from which `notes` says so."""
# A wrist this far from its target is out of reach [m], in more than this share of the samples.
_WRIST_OFF, _LATE_SHARE = 0.02, 0.05
# A waist that is at a limit in more than this share of the samples may make a robot fall.
_BENT_SHARE = 0.05
_AT_ONCE = 10_000
"""Samples of which speeds and accelerations are computed at once."""
_NAMED_JOINTS = 3
_NAMED_HOLDS = 5


def summarise(trajectory: Trajectory) -> Values:
    """Summarise a mapped motion by numbers, with the unit in their name.

    Errors and times are taken over the samples that the robot followed, `samples_at_limit` over
    all. `held` counts the others, `rules` how many samples broke each rule, and `events` lists the
    holds. `consistency_mm_mean` is the mean RMS difference of bones and palm from the person's.
    `speed_limited_share` is the share of the followed samples in which a speed limit held a joint;
    `speed_limited_joints` has the joints held most often, with share and limit [rad/s or m/s].
    `assumed_speed_share` is the share of the followed samples in which a limit that is assumed
    (`HandSpec.assumed_speeds`) held a joint; None if no speed is assumed.
    `arm_out_of_reach` has the share of samples, what holds the arm in them (`arm_held_by`), the
    largest error, the extent of the motion and a scale to try (None for a robot with two hands), of
    an arm that does not follow; None if it does. `leaning` has joints that carry another limb too
    (`Hand.carries_limbs`), such as a waist: how far each went from rest [rad or m], and the share
    of the samples in which it was at a limit.

    What was written is judged by its own instants: `speed_over_limit_max` is the largest speed of a
    joint over its limit, `acceleration_max` the largest acceleration [rad/s^2 or m/s^2], and
    `steps_ms` the shortest, the median and the longest time between samples; None where there are
    too few samples.
    """
    robot = trajectory.robot
    seen = trajectory.valid
    is_slow = trajectory.at_speed_limit[seen]
    shares = is_slow.mean(axis=0)
    assumed = assumed_joints(robot)
    is_assumed = np.isin(robot.joint_names, assumed)
    points = 1e3 * trajectory.point_error[seen]
    step = 1e6 * trajectory.step_cpu[seen]
    consistency = trajectory.consistency[~np.isnan(trajectory.consistency)]
    found = {
        "robot": robot.name,
        "samples": len(trajectory.time),
        "held": (~seen).sum(),
        "rules": count_broken(Counter(trajectory.rule.tolist())),
        "events": find_holds(trajectory),
        "consistency_mm_mean": (1e3 * consistency).mean() if len(consistency) else None,
        "confidence_mean": trajectory.confidence[seen].mean(),
        "step_cpu_us_median": np.median(step),
        "step_cpu_us_p99": np.percentile(step, 99),
        "point_error_mm_mean": points.mean(),
        "point_error_mm_p95": np.percentile(points, 95),
        "point_error_mm_max": points.max(),
        "wrist_error_mm_mean": 1e3 * trajectory.wrist_error[seen].mean(),
        "samples_at_limit": trajectory.at_limit.any(axis=1).sum(),
        "limit_violation_max": trajectory.limit_violation,
        **by_instants(trajectory),
        "speed_limited_share": is_slow.any(axis=1).mean(),
        "assumed_speed_share": is_slow[:, is_assumed].any(axis=1).mean()
        if assumed
        else None,
        # The joints that speed limits held most often.
        "speed_limited_joints": [
            {
                "joint": robot.joint_names[i],
                "share": shares[i],
                "limit": robot.velocity_limits[i],
            }
            for i in np.argsort(-shares, kind="stable")[:_NAMED_JOINTS]
            if shares[i] > 0.0
        ],
        "arm_out_of_reach": _arm(trajectory),
        "leaning": measure_leaning(
            robot, trajectory.q, trajectory.at_limit, samples=seen
        ).rows,
    }
    return plain_values(found)


def plain_values(values: Values) -> Values:
    """Return values as plain numbers, for every encoder."""
    return msgspec.to_builtins(values, enc_hook=np.generic.item)


def find_holds(trajectory: Trajectory) -> list[Values]:
    """Find the holds of a mapped motion, in the order of time.

    Each has the `rule` that began it (`human.sample.RULES`); `start`, the time of its first sample
    from the first sample of all on [s]; `duration` to the first sample that is followed again, or
    to the end [s]; `samples` that were not followed.
    """
    return holds_in(trajectory.time, trajectory.valid, trajectory.rule.__getitem__)


def holds_in(
    instants: Array, valid: Array, rule_at: Callable[[int], str]
) -> list[Values]:
    """Find the holds of a motion (`find_holds`) by its columns.

    Args:
        instants: Instants [s], shape (T,).
        valid: Which samples were followed, shape (T,).
        rule_at: Returns the rule of a sample.
    """
    last = len(instants) - 1

    def time_of(sample: int) -> float:
        return instants[sample] - instants[0]

    return [
        {
            "rule": rule_at(hold.start),
            "start": time_of(hold.start),
            "duration": time_of(min(hold.stop, last)) - time_of(hold.start),
            "samples": hold.stop - hold.start,
        }
        for hold in stretches(~valid)
    ]


def compare_closing(
    human: Hand, robot: Hand, recordings: Sequence[Recording]
) -> Values | None:
    """Compare how long robot and person take to close their hands.

    Args:
        human: The human hand, or the hands of a person as one (`joined`).
        robot: The robot hand, or a robot.
        recordings: The recordings that were mapped.

    Returns:
        `robot_s`, the robot's time for a fist, `joint` and `is_assumed` (`fist_time`); `person_s`,
        the median time in which the person closed a finger, and `closings`, how often
        (`closing_times`). None if the person closes no finger.

    Raises:
        HandmapError: As `fist_time`.
    """
    times = np.concatenate([closing_times(each) for each in recordings])
    if not len(times):
        return None
    fist = fist_time(human, robot)
    return {
        "robot_s": fist.time,
        "joint": fist.joint,
        "is_assumed": fist.is_assumed,
        "person_s": float(np.median(times)),
        "closings": len(times),
    }


def notes(summary: Values) -> list[str]:
    """Return a line each if speed limits or a short arm held the robot, or its waist was bent.

    Args:
        summary: Of `summarise`; a value `closing` is that of `compare_closing`.
    """
    lines = [line for line in [_speed_note(summary)] if line]
    if arm := summary["arm_out_of_reach"]:
        reasons = ", ".join(
            f"{name} {100.0 * share:.0f} %" for name, share in arm["held_by"].items()
        )
        advice = "hands near each other keep the person's distance at any --scale"
        if arm["scale"]:
            advice = (
                f"try --scale {arm['scale']:.2g}, or start in the middle of the arm's "
                "range"
            )
        lines.append(
            f"the arm does not follow the motion of about {arm['motion_mm']:.0f} mm: the wrist is "
            f"up to {arm['error_mm']:.0f} mm off its target, in {100.0 * arm['share']:.0f} % of "
            f"the samples, held by {reasons}; {advice}"
        )
    bent = [
        f"{row['joint']} in {100.0 * row['at_limit_share']:.0f} %"
        for row in summary["leaning"]
        if row["at_limit_share"] > _BENT_SHARE
    ]
    if bent:
        lines.append(
            f"joints that carry another limb too were at a limit ({', '.join(bent)} of the "
            "samples): with a bent waist, a robot that stands may fall; reach less far (--scale), "
            "or give them `joint_weights` in robot.yaml or hand.yaml"
        )
    return lines


def _speed_note(summary: Values) -> str:
    """Return a line if the robot's joints are too slow for the person; empty if not."""
    share = summary["speed_limited_share"]
    closing = summary.get("closing")
    is_slower = closing is not None and closing["robot_s"] > closing["person_s"]
    assumed = summary["assumed_speed_share"] or 0.0
    if not is_slower and share <= SLOW_SHARE and assumed <= ASSUMED_SHARE:
        return ""
    joints = ", ".join(
        f"{row['joint']} ({row['limit']:.3g} per s)"
        for row in summary["speed_limited_joints"]
    )
    held = f"speed limits held a joint in {100.0 * share:.0f} % of the samples"
    place = "in `limits` of its hand.yaml"
    if assumed > 0.0:
        held += f", assumed ones in {100.0 * assumed:.0f} %"
        place = f"by `handmap hands init --speed` or {place}"
    line = f"{held}, most often {joints}: move more slowly, or give the robot's true limits {place}"
    if not is_slower:
        return line
    speeds = "assumed speed limits" if closing["is_assumed"] else "speed limits"
    return (
        f"the robot takes {closing['robot_s']:.2f} s for a fist at its {speeds}, and this person "
        f"{closing['person_s']:.2f} s to close a finger (median of {closing['closings']}): the "
        f"robot follows late; {line}"
    )


def table_rows(summary: Values) -> dict[str, str]:
    """Return the values of a summary as text, with their units, by label."""
    events = summary["events"]
    holds = [
        f"{event['rule']} at {event['start']:.2f} s for {event['duration']:.2f} s"
        for event in events[:_NAMED_HOLDS]
    ]
    if len(events) > _NAMED_HOLDS:
        holds.append(f"{len(events) - _NAMED_HOLDS} more")
    consistency = summary["consistency_mm_mean"]
    return {
        "samples": f"{summary['samples']}, {summary['held']} not followed (robot held still)",
        "holds": "; ".join(holds) or "none",
        "bones and palm off the person's": "not measured"
        if consistency is None
        else f"{consistency:.1f} mm RMS",
        "step, CPU time": (
            f"{summary['step_cpu_us_median']:.0f} us median, "
            f"{summary['step_cpu_us_p99']:.0f} us p99"
        ),
        "point error": (
            f"{summary['point_error_mm_mean']:.2f} mm mean, "
            f"{summary['point_error_mm_p95']:.2f} mm p95, "
            f"{summary['point_error_mm_max']:.2f} mm max"
        ),
        "wrist error": f"{summary['wrist_error_mm_mean']:.2f} mm mean",
        "samples at a limit": f"{summary['samples_at_limit']}",
        "samples held by a speed limit": _held_share(summary),
        **_leaning_rows(summary),
        "largest limit violation": f"{summary['limit_violation_max']:.1e} rad",
        **_time_rows(summary),
    }


def _held_share(summary: Values) -> str:
    """Return the share of samples that speed limits held as text, and that of assumed ones."""
    text = f"{100.0 * summary['speed_limited_share']:.1f} %"
    assumed = summary["assumed_speed_share"]
    return (
        text
        if assumed is None
        else f"{text}, by an assumed one {100.0 * assumed:.1f} %"
    )


def by_instants(trajectory: Trajectory) -> Values:
    """Judge what is written by its own instants; see `summarise`."""
    found: Values = dict.fromkeys(
        ("speed_over_limit_max", "acceleration_max", "steps_ms")
    )
    parts = [*_overlapping(trajectory)]
    if len(trajectory.time) > 1:
        limits = trajectory.robot.velocity_limits
        shares = [(np.abs(part.speeds) / limits).max() for part in parts]
        found["speed_over_limit_max"] = np.max(shares)
        found["steps_ms"] = steps_in(trajectory.time)
    if len(trajectory.time) > 2:
        largest = [np.abs(part.accelerations).max() for part in parts]
        found["acceleration_max"] = np.max(largest)
    return found


def _overlapping(motion: RobotMotion) -> Iterator[RobotMotion]:
    """Cut a motion into parts that have each step, and each pair of steps, in one of them."""
    columns = ("time", "q", "wrist", "step_cpu")
    # The last part has three samples if there are so many.
    for start in range(0, max(1, len(motion.time) - 2), _AT_ONCE):
        samples = slice(start, start + _AT_ONCE + 2)
        arrays = {name: vars(motion)[name][samples] for name in columns}
        yield RobotMotion(robot=motion.robot, **arrays)


def steps_in(instants: Array) -> list[float]:
    """Return the least, the median and the largest step between two or more instants [ms]."""
    steps = np.diff(instants)
    # In place: those of a day take 21 MB.
    steps *= 1e3
    least, largest = steps.min(), steps.max()
    return [least, np.median(steps, overwrite_input=True), largest]


def count_broken(rules: Counter[str]) -> dict[str, int]:
    """Return how many samples broke each rule, the most frequent first; no rule has the name ''."""
    broken = sorted(rules.keys() - {""})
    return dict(Counter({name: rules[name] for name in broken}).most_common())


def _time_rows(summary: Values) -> dict[str, str]:
    """Return what was judged by the instants of the samples as text, by label."""
    if summary["steps_ms"] is None:
        return {}
    shortest, median, longest = summary["steps_ms"]
    rows = {
        "times, as the file has them": (
            f"{1e3 / median:.4g} samples a second, steps of {shortest:.4g} to "
            f"{longest:.4g} ms"
        ),
        "largest speed": f"{summary['speed_over_limit_max']:.3f} of its limit",
    }
    if summary["acceleration_max"] is not None:
        rows["largest acceleration"] = f"{summary['acceleration_max']:.3g} per s^2"
    return rows


def _leaning_rows(summary: Values) -> dict[str, str]:
    """Return how far a robot leans as text, by label; nothing for one that cannot."""
    found = [
        f"{row['joint']} by up to "
        + (
            f"{np.degrees(row['most']):.0f} deg"
            if row["is_angle"]
            else f"{1e3 * row['most']:.0f} mm"
        )
        for row in summary["leaning"]
    ]
    return {"leans": "; ".join(found)} if found else {}


def _arm(trajectory: Trajectory) -> Values | None:
    """Measure how far a motion leaves an arm's reach, and what scale fits; None if it does not."""
    robot = trajectory.robot
    places = trajectory.wrist[trajectory.valid, :3, 3]
    errors = trajectory.wrist_error[trajectory.valid]
    late = errors > _WRIST_OFF
    if not (robot.is_on_arm and late.mean() > _LATE_SHARE):
        return None
    moved = lengths(places - places[0])
    wanted = moved + errors
    reasons = arm_held_by(robot, trajectory.at_speed_limit, trajectory.at_limit)
    counted = Counter(reasons[trajectory.valid][late].tolist())
    scale = (moved[late] / wanted[late]).min()
    return {
        "share": late.mean(),
        "error_mm": 1e3 * errors.max(),
        "motion_mm": 1e3 * wanted.max(),
        "held_by": {name: n / late.sum() for name, n in counted.most_common()},
        # Palms near each other are not scaled.
        "scale": None if robot.parts else max(0.05, np.floor(20.0 * scale) / 20.0),
    }
