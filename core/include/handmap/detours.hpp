// A way round, from a posture that holds fingers.
//
// Rows may hold a finger behind others, or a folded one, far from its target though another posture is
// near: a QP finds the nearest minimum. Where a point is away from its target, or thumb and finger do not
// meet, and neither is on its way, the hand looks ahead by the same QPs: where would it end if it went by
// its rest posture, or by straighter fingers? If that is clearly nearer than where it has come to meanwhile,
// the joints are pulled to that posture first. Every step passes the gate. Each hand of a robot looks by
// itself.
//
// A look takes some thirty QPs, which are solved roughly: nothing that is foreseen is a command. The hand
// foresees a few of them in each sample, and goes on meanwhile. They are granted by the time of the
// samples and counted, so that a robot does the same on every computer.
#pragma once

#include "ik.hpp"

namespace handmap {
// A point or pinch whose weighted error is larger is away from its target [cost]: 20 mm for a fingertip,
// 4 mm for a pinch of `teleoperation` at its full weight.
constexpr double kAway = 2.0;
// Pads that meet are this far above what their row asks for, which is an overlap [m].
constexpr double kPressed = 0.004;
// A point is on its way where a joint moves it by more than this share of its speed limit.
constexpr double kOnItsWay = 0.7;
// To look ahead: time of a sample that is foreseen [s].
constexpr double kSample = 0.1;
// QPs that are foreseen in a second, and in one sample at most, of one hand; none in a sample that has
// measured so many distances. A look that has not ended after this time is given up [s].
constexpr double kForeseen = 800.0, kForeseenAtOnce = 8.0;
constexpr std::int64_t kMostDistances = 250;
constexpr double kLongestLook = 1.0;
// Time until the hand looks ahead again: after a detour, and where none is known [s].
constexpr double kAgain = 0.1, kLater = 0.2;
// A detour is worth it if these shares are left of the error of a point that was away and of the sum of all
// squares, or this share of that sum.
constexpr double kOfPoint = 0.75, kOfAll = 0.85, kOfMost = 0.7;
// Weight of the pull to a posture, which outweighs all targets; distance of its joints at which it is
// reached [rad or m], and the longest time for it, in samples.
constexpr double kPull = 20.0, kReached = 0.15;
constexpr int kLongest = 3;
// Share of the rest posture's angles that straighter fingers keep; most models are straight at zero.
constexpr double kStraighter = 0.7;
// A pinch is held where its row has this weight [cost]/[m]: nine tenths of that of `teleoperation`.
constexpr double kHeld = 450.0;
// Targets that move farther than this end a detour [m].
constexpr double kMoved = 0.05;
// Where none is known, errors have to grow by this share before the hand looks again, or this time has to
// pass [s].
constexpr double kGrown = 1.3, kForgotten = 2.0;

// Solves a sample with detours of the hands before `end`, each where that leads it nearer to its
// targets.
inline void solve_with_detours(Ik& ik, size_t end, const Goal& goal, const When& when,
                               const Vector& margins, double speed, Result& result);

// The detours of one hand.
class Detours {
 public:
  Detours(Ik& ik, size_t part)
      : ik_(ik),
        index_(part),
        part_(ik.tree.parts[part]),
        is_finger_(ik.tree.fingers[part]),
        detour_(ik.detours[part]),
        work_(ik.detour_work[part]) {}

  void solve(const Goal& goal, const When& when, const Vector& margins, double speed,
             Result& result) {
    const double dt = ik_.motion.next(when).granted;
    const std::int64_t before = distances();
    make_room(goal);
    detour_.wait -= dt;
    if (!detour_.points.empty() && moved_by(goal) > kMoved) give_up({}, 0.0);
    const bool is_on_detour = !detour_.via.empty();
    // The goal has a further posture in every sample, so that a search finds the memory for it.
    work_.goal = goal;
    work_.goal.pull(kPull, is_on_detour ? detour_.via : ik_.tree.joint_rest, is_finger_);
    if (is_on_detour) {
      solve_with_detours(ik_, index_, work_.goal, when, margins, speed, result);
      const bool is_late = detour_.left < dt;
      detour_.left -= dt;
      if (is_at(detour_.via))
        give_up({}, kAgain);
      else if (is_late)
        give_up(detour_.known, kLater);
      return;
    }
    solve_with_detours(ik_, index_, goal, when, margins, speed, result);
    if (detour_.wait <= -kForgotten) detour_.known.clear();
    if (!is_any_looking() && detour_.wait <= 0.0) begin_to_look(goal, result, dt * speed);
    if (is_looking()) look_ahead(goal, margins, result, dt, speed, before + kMostDistances);
  }

 private:
  using Candidate = Foresight::Candidate;
  using Way = Foresight::Way;

  Ik& ik_;
  const size_t index_;
  const Part& part_;
  const Vector& is_finger_;
  Detour& detour_;
  DetourWork& work_;
  Foresight& foresight_ = detour_.foresight;

  bool is_looking() const { return foresight_.is_looking(); }

  // Hands of one robot look one after the other.
  bool is_any_looking() const {
    return std::any_of(ik_.detours.begin(), ik_.detours.end(),
                       [](const Detour& each) { return each.foresight.is_looking(); });
  }

  // Take the memory of a search, which is rare, in the first sample.
  void make_room(const Goal& goal) {
    size_t errors = goal.points.size();
    for (const AimedDistances& aimed : goal.distances) errors += aimed.weights.size();
    detour_.reserve(ik_.tree, errors);
    work_.errors.reserve(errors);
  }

  // How many distances were measured until now.
  std::int64_t distances() const { return ik_.pairs ? ik_.pairs->queries : 0; }

  // A QP of two hands costs some four times that of one.
  double at_once() const {
    const double hands = static_cast<double>(ik_.tree.parts.size());
    return kForeseenAtOnce / (hands * hands);
  }

  // End a detour, or a look ahead. Errors are known where none is nearer.
  void give_up(const Vector& known, double wait) {
    detour_.via.clear();
    detour_.points.clear();
    detour_.known = known;
    detour_.left = 0.0;
    detour_.wait = wait;
    foresight_.candidate = Candidate::none;
  }

  // Look ahead if a point or a pinch is away, and not on its way.
  void begin_to_look(const Goal& goal, const Result& result, double time) {
    find_errors(goal, result, work_.errors);
    if (!is_held_away(goal, work_.errors, result, time)) return;
    detour_.points = goal.points;
    // A copy of empty lists leaves these their memory.
    const Foresight fresh;
    foresight_ = fresh;
    foresight_.credit = at_once();
    detour_.left = kLongestLook;
    try_candidate(Candidate::rest, goal);
  }

  void try_candidate(Candidate candidate, const Goal& goal) {
    foresight_.candidate = candidate;
    find_posture(candidate, goal, foresight_.posture);
    go(Way::by_candidate, foresight_.posture);
  }

  // Begin to foresee a way, from where the hand is.
  void go(Way way, const Vector& via) {
    foresight_.way = way;
    foresight_.via = via;
    foresight_.is_past = via.empty();
    foresight_.steps = 0;
    foresight_.motion = ik_.motion;
  }

  // Foresee as much as a time [s] grants, until so many distances were measured.
  void look_ahead(const Goal& given, const Vector& margins, const Result& result, double dt,
                  double speed, std::int64_t most_distances) {
    Goal& goal = work_.goal;
    Vector& here = work_.errors;
    find_errors(given, result, here);
    const bool is_held = is_held_away(given, here, result, dt * speed);
    goal.postures.shorten(1);
    detour_.left -= dt;
    if (detour_.left < 0.0) return give_up(here, kLater);
    foresight_.credit = std::min(foresight_.credit + kForeseen * dt, at_once());
    while (is_looking() && foresight_.credit >= 1.0 && distances() < most_distances) {
      std::swap(ik_.motion, foresight_.motion);
      const bool has_ended = foresee(goal, margins);
      std::swap(ik_.motion, foresight_.motion);
      foresight_.credit -= 1.0;
      if (has_ended) conclude(given, here, is_held);
    }
    ik_.at.place(ik_.motion.q.data());
  }

  // Foresee one QP; whether the way has ended.
  bool foresee(Goal& goal, const Vector& margins) {
    const When next = When::after(kSample);
    Result& result = work_.foreseen;
    ++foresight_.steps;
    if (!foresight_.is_past) {
      goal.pull(kPull, foresight_.via, is_finger_);
      ik_.solve(goal, next, margins, 1.0, result, kRough);
      goal.postures.shorten(1);
      foresight_.is_past = is_at(foresight_.via) || foresight_.steps == kLongest;
      if (foresight_.is_past) foresight_.steps = 0;
      return false;
    }
    ik_.solve(goal, next, margins, 1.0, result, kRough);
    find_errors(goal, result, foresight_.ended);
    if (foresight_.way == Way::by_candidate) find_joints(foresight_.joints);
    const auto& ended = foresight_.ended;
    return foresight_.steps >= kSamplesAhead || *std::max_element(ended.begin(), ended.end()) <= kAway;
  }

  // Foresee the next way, take a detour, or give up. `here` are the errors where the hand is now.
  void conclude(const Goal& goal, const Vector& here, bool is_held) {
    const Vector& ended = foresight_.ended;
    // Another method has other distances; and the hand may have come on by itself.
    const bool has_found = foresight_.way != Way::by_candidate;
    if (here.size() != ended.size() || (has_found && foresight_.found.size() != here.size()) ||
        (foresight_.has_ahead && foresight_.ahead.size() != here.size()) || !is_held)
      return give_up({}, 0.0);
    if (foresight_.way == Way::by_candidate) {
      if (!is_nearer(ended, foresight_.has_ahead ? foresight_.ahead : here)) return try_next(goal, here);
      foresight_.found = ended;
      // It may get there slowly by itself.
      if (!foresight_.has_ahead) return go(Way::by_itself, {});
    } else if (foresight_.way == Way::by_itself) {
      foresight_.ahead = ended;
      foresight_.has_ahead = true;
      if (!is_nearer(foresight_.found, ended)) return try_next(goal, here);
    }
    if (foresight_.way != Way::direct) return go(Way::direct, foresight_.joints);
    const bool is_direct = is_nearer(ended, foresight_.ahead);
    detour_.via = is_direct ? foresight_.joints : foresight_.posture;
    detour_.known = here;
    detour_.left = kLongest * kSample;
    detour_.wait = 0.0;
    foresight_.candidate = Candidate::none;
  }

  // Tips that have passed each other touch as well: they come back by straighter fingers.
  void try_next(const Goal& goal, const Vector& here) {
    if (foresight_.candidate == Candidate::rest && is_pinching(goal))
      return try_candidate(Candidate::straighter, goal);
    give_up(foresight_.has_ahead ? foresight_.ahead : here, kLater);
  }

  // Write a posture that may be a detour.
  void find_posture(Candidate candidate, const Goal& goal, Vector& to) const {
    const Tree& tree = ik_.tree;
    to = candidate == Candidate::rest ? goal.postures[0].q : tree.joint_rest;
    if (candidate == Candidate::rest) return;
    for (size_t j = 0; j < to.size(); ++j)
      to[j] = std::clamp(kStraighter * tree.joint_rest[j], tree.lower[j], tree.upper[j]);
  }

  bool is_pinching(const Goal& goal) const {
    bool is_any = false;
    for_pinches(goal, [&](const Attached&, const Attached&, double, double weight) {
      is_any |= weight / kLengthUnit > kHeld;
    });
    return is_any;
  }

  // How far the farthest target is from where the detour was looked for.
  double moved_by(const Goal& goal) const {
    double most = 0.0;
    for (size_t k = part_.first; k < std::min(part_.end, detour_.points.size()); ++k)
      most = std::max(most, norm(goal.points[k] - detour_.points[k]));
    return most;
  }

  bool is_at(const Vector& posture) const {
    double most = 0.0;
    for (size_t j = 0; j < posture.size(); ++j)
      most = std::max(most, is_finger_[j] *
                                std::abs(ik_.motion.q[ik_.tree.q_indices[j]] - posture[j]));
    return most < kReached;
  }

  // Whether a point or a pinch is away, and what moves it is not on its way.
  bool is_held_away(const Goal& goal, const Vector& errors, const Result& result,
                    double time) const {
    size_t k = 0;
    for (size_t point = part_.first; point < part_.end; ++point, ++k)
      if (is_new(errors, k) && !is_on_its_way(ik_.tree.points[point].joint, result, time))
        return true;
    bool is_any = false;
    for_pinches(goal, [&](const Attached& thumb, const Attached& finger, double, double) {
      is_any |= is_new(errors, k++) && !is_on_its_way(thumb.joint, result, time) &&
                !is_on_its_way(finger.joint, result, time);
    });
    return is_any;
  }

  // Whether a joint of its finger moves what is on a joint nearly as fast as it can.
  bool is_on_its_way(int joint, const Result& result, double time) const {
    return any_finger_joint(joint, [&](int i) {
      return std::abs(result.displacement[i]) > kOnItsWay * time * ik_.limits.speeds[i];
    });
  }

  // Whether something holds for any of the fingers' coordinates that move what is on a joint.
  template <class Holds>
  bool any_finger_joint(int joint, const Holds& holds) const {
    if (joint < 0) return false;
    const std::vector<int>& moving = ik_.tree.moving[joint];
    for (size_t j = 0; j < is_finger_.size(); ++j) {
      const int i = ik_.tree.joint_columns[j];
      if (is_finger_[j] != 0.0 && std::binary_search(moving.begin(), moving.end(), i) && holds(i))
        return true;
    }
    return false;
  }

  // Whether a joint is another one, or carries it.
  bool carries(int joint, int other) const {
    while (other > joint) other = ik_.tree.joints[other].parent;
    return other == joint;
  }

  // Call with both ends of each distance between two fingers of this hand, its aim and its weight.
  template <class Call>
  void for_pinches(const Goal& goal, const Call& call) const {
    const auto is_of_finger = [&](const Attached& point) {
      return any_finger_joint(point.joint, [](int) { return true; });
    };
    for (const AimedDistances& aimed : goal.distances)
      for (size_t k = 0; k < aimed.weights.size(); ++k) {
        const Attached& a = aimed.task->points[aimed.task->first[k]];
        const Attached& b = aimed.task->points[aimed.task->second[k]];
        // Along one finger, a joint carries the other: that is its extension.
        if (carries(a.joint, b.joint) || carries(b.joint, a.joint)) continue;
        if (is_of_finger(a) && is_of_finger(b)) call(a, b, aimed.aims[k], aimed.weights[k]);
      }
  }

  void find_joints(Vector& to) const {
    to.clear();
    for (const int i : ik_.tree.q_indices) to.push_back(ik_.motion.q[i]);
  }

  // Write the errors of the points, then of pinches that are too wide, where the hand is [cost].
  void find_errors(const Goal& goal, const Result& result, Vector& to) const {
    to.clear();
    for (size_t k = part_.first; k < part_.end; ++k)
      to.push_back(ik_.weights.points[k] * norm(result.targets[k] - result.points[k]));
    for_pinches(goal, [&](const Attached& a, const Attached& b, double aim, double weight) {
      const double gap = norm(ik_.at.point(a) - ik_.at.point(b));
      to.push_back(weight / kLengthUnit * std::max(gap - aim - kPressed, 0.0));
    });
  }

  // Whether a point is away, by more than where no way round is known.
  bool is_new(const Vector& errors, size_t k) const {
    const double known = k < detour_.known.size() ? kGrown * detour_.known[k] : 0.0;
    return errors[k] > std::max(kAway, known);
  }

  // Whether errors are clearly less than others, of which one at least is away.
  bool is_nearer(const Vector& errors, const Vector& other) const {
    bool is_any = false, is_away = false;
    double squares = 0.0, squares_other = 0.0;
    for (size_t k = 0; k < errors.size(); ++k) {
      is_away |= other[k] > kAway;
      is_any |= other[k] > kAway && errors[k] < kOfPoint * other[k];
      squares += errors[k] * errors[k];
      squares_other += other[k] * other[k];
    }
    return (is_any && squares < kOfAll * squares_other) ||
           (is_away && squares < kOfMost * squares_other);
  }
};

inline void solve_with_detours(Ik& ik, size_t end, const Goal& goal, const When& when,
                               const Vector& margins, double speed, Result& result) {
  if (end == 0)
    ik.solve(goal, when, margins, speed, result);
  else
    Detours(ik, end - 1).solve(goal, when, margins, speed, result);
}

// Move the hand for one sample, by detours if its options allow any.
inline void seek(Ik& ik, const Goal& goal, const When& when, const Vector& margins, double speed,
                 Result& result) {
  if (!ik.takes_detours) {
    ik.solve(goal, when, margins, speed, result);
    return;
  }
  ik.sought_from = ik.motion;
  try {
    const size_t count = ik.tree.parts.size();
    solve_with_detours(ik, count, goal, when, margins, speed, result);
  } catch (...) {
    // What was foreseen is not where the hand is.
    ik.motion = ik.sought_from;
    ik.stop_detours();
    throw;
  }
}

}  // namespace handmap
