// A way round, from a posture that holds fingers: see handmap_qp/ik/collision.py, whose names these are.
#pragma once

#include "ik.hpp"

namespace handmap {

// Solves a sample with detours of the hands before `end`, each where that leads it nearer to its
// targets.
inline void solve_with_detours(Ik& ik, size_t end, const Goal& goal, const When& when,
                               const Vector& margins, double speed, Result& result);

// The detours of one hand.
class Detours {
 public:
  Detours(Ik& ik, size_t part)
      : ik_(ik),
        rules_(*ik.detour_rules),
        index_(part),
        part_(ik.tree.parts[part]),
        is_finger_(ik.fingers[part]),
        detour_(ik.detours[part]) {}

  void solve(const Goal& goal, const When& when, const Vector& margins, double speed,
             Result& result) {
    const double dt = ik_.motion.next(when).granted;
    detour_.wait -= dt;
    if (!detour_.via.empty() && moved_by(goal) > rules_.moved) detour_.via.clear();
    if (!detour_.via.empty()) {
      solve_with_detours(ik_, index_, pulled(goal, detour_.via), when, margins, speed, result);
      const bool is_late = detour_.left < dt;
      detour_.left -= dt;
      if (is_late || is_at(detour_.via)) detour_ = {{}, {}, {}, 0.0, rules_.again};
      return;
    }
    solve_with_detours(ik_, index_, goal, when, margins, speed, result);
    if (detour_.wait <= -rules_.forgotten) detour_.known.clear();
    if (detour_.wait <= 0.0) look_ahead(goal, margins, result, dt * speed);
  }

 private:
  Ik& ik_;
  const DetourRules& rules_;
  const size_t index_;
  const Part& part_;
  const Vector& is_finger_;
  Detour& detour_;

  struct End {
    Vector errors, joints;
  };

  void look_ahead(const Goal& goal, const Vector& margins, const Result& result, double time) {
    const Vector here = errors(result);
    bool is_held_away = false;
    for (size_t k = 0; k < here.size(); ++k)
      is_held_away |= is_new(here, k) && !is_on_its_way(part_.first + k, result, time);
    if (!is_held_away) return;
    const Vector& rest = goal.postures.front().q;
    const End found = foresee(goal, margins, rest);
    Vector ahead = here;
    // It may get there slowly by itself.
    if (is_nearer(found.errors, here)) ahead = foresee(goal, margins, {}).errors;
    if (!is_nearer(found.errors, ahead)) {
      detour_ = {{}, {}, ahead, 0.0, rules_.later};
      return;
    }
    const bool is_direct = is_nearer(foresee(goal, margins, found.joints).errors, ahead);
    detour_ = {is_direct ? found.joints : rest, goal.points, {}, rules_.longest * rules_.sample, 0.0};
  }

  // Errors of the points and joints where the hand ends.
  End foresee(const Goal& given, const Vector& margins, const Vector& via) {
    const Motion motion = ik_.motion;
    const When next = When::after(rules_.sample);
    Goal goal = given;
    goal.postures.resize(1);
    Result result;
    for (int k = 0; !via.empty() && k < rules_.longest; ++k) {
      ik_.solve(pulled(goal, via), next, margins, 1.0, result);
      if (is_at(via)) break;
    }
    End end;
    for (int k = 0; k < rules_.samples; ++k) {
      ik_.solve(goal, next, margins, 1.0, result);
      end.errors = errors(result);
      if (*std::max_element(end.errors.begin(), end.errors.end()) <= rules_.away) break;
    }
    end.joints = joints();
    ik_.motion = motion;
    return end;
  }

  Goal pulled(const Goal& goal, const Vector& posture) const {
    Goal towards = goal;
    towards.postures.push_back({rules_.pull, posture, is_finger_});
    return towards;
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
    return most < rules_.reached;
  }

  // Whether a joint of its finger moves a point nearly as fast as it can.
  bool is_on_its_way(size_t point, const Result& result, double time) const {
    const int joint = ik_.tree.points[point].joint;
    if (joint < 0) return false;
    const std::vector<int>& moving = ik_.tree.moving[joint];
    for (size_t j = 0; j < is_finger_.size(); ++j) {
      const int i = ik_.tree.joint_columns[j];
      const double most = rules_.on_its_way * time * ik_.limits.speeds[i];
      if (is_finger_[j] != 0.0 && std::abs(result.displacement[i]) > most &&
          std::binary_search(moving.begin(), moving.end(), i))
        return true;
    }
    return false;
  }

  Vector joints() const {
    Vector found;
    for (const int i : ik_.tree.q_indices) found.push_back(ik_.motion.q[i]);
    return found;
  }

  Vector errors(const Result& result) const {
    Vector found;
    for (size_t k = part_.first; k < part_.end; ++k)
      found.push_back(ik_.weights.points[k] * norm(result.targets[k] - result.points[k]));
    return found;
  }

  // Whether a point is away, by more than where no way round is known.
  bool is_new(const Vector& errors, size_t k) const {
    const double known = detour_.known.empty() ? 0.0 : rules_.grown * detour_.known[k];
    return errors[k] > std::max(rules_.away, known);
  }

  bool is_nearer(const Vector& errors, const Vector& other) const {
    bool is_any = false;
    double squares = 0.0, squares_other = 0.0;
    for (size_t k = 0; k < errors.size(); ++k) {
      is_any |= other[k] > rules_.away && errors[k] < rules_.of_point * other[k];
      squares += errors[k] * errors[k];
      squares_other += other[k] * other[k];
    }
    return is_any && squares < rules_.of_all * squares_other;
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
  if (!ik.detour_rules) {
    ik.solve(goal, when, margins, speed, result);
    return;
  }
  const Motion motion = ik.motion;
  try {
    const size_t count = ik.tree.parts.size();
    solve_with_detours(ik, count, goal, when, margins, speed, result);
  } catch (...) {
    // What was foreseen is not where the hand is.
    ik.motion = motion;
    ik.stop_detours();
    throw;
  }
}

}  // namespace handmap
