// A way round, from a posture that holds fingers: see handmap_qp/ik/collision.py, whose names these are.
#pragma once

#include "ik.hpp"

namespace handmap {

// Solves a sample, by a detour where that leads nearer to the targets.
class Detours {
 public:
  explicit Detours(Ik& ik) : ik_(ik), rules_(*ik.detour_rules), detour_(ik.detour), is_finger_(ik.tree.joint_columns.size()) {
    static const std::vector<int> none;
    const int joint = ik.tree.wrist_origin.joint;
    const std::vector<int>& arm = joint < 0 ? none : ik.tree.moving[joint];
    for (size_t j = 0; j < is_finger_.size(); ++j)
      is_finger_[j] =
          std::find(arm.begin(), arm.end(), ik.tree.joint_columns[j]) == arm.end() ? 1.0 : 0.0;
  }

  void solve(const Goal& goal, double dt, const Vector& margins, double speed, Result& result) {
    dt = std::max(dt, kShortestDt);
    detour_.wait -= dt;
    const double moved = moved_by(goal);
    if (moved > rules_.moved) detour_.via.clear();
    if (!detour_.via.empty()) {
      ik_.solve(pulled(goal, detour_.via.front()), dt, margins, speed, result);
      detour_.left -= dt;
      if (detour_.left < 0.0 || is_at(detour_.via.front())) {
        detour_.via.erase(detour_.via.begin());
        detour_.left = rules_.longest * rules_.sample;
        detour_.wait = rules_.after;
      }
      return;
    }
    ik_.solve(goal, dt, margins, speed, result);
    const bool is_due = detour_.wait <= (moved > rules_.same ? 0.0 : -rules_.forgotten);
    if (is_due && largest(errors(goal, result)) > rules_.away) look_ahead(goal, margins);
  }

 private:
  Ik& ik_;
  const DetourRules& rules_;
  Detour& detour_;
  Vector is_finger_;  // 0 for the joints of an arm, which follow the wrist at all times

  struct End {
    Vector errors, joints;
  };

  void look_ahead(const Goal& goal, const Vector& margins) {
    const Vector ahead = foresee(goal, margins, {}).errors;
    detour_ = {{}, {}, 0.0, rules_.again};
    if (largest(ahead) <= rules_.away) return;
    detour_ = {{}, goal.points, 0.0, rules_.later};
    const Vector& rest = goal.postures.front().q;
    const Motion motion = ik_.motion;
    start_from(rest);
    const End found = foresee(goal, margins, {});
    ik_.motion = motion;
    if (!is_nearer(found.errors, ahead)) return;
    const std::vector<Vector> ways[] = {{found.joints}, {rest, found.joints}};
    for (const std::vector<Vector>& via : ways)
      if (is_nearer(foresee(goal, margins, via).errors, ahead)) {
        detour_ = {via, goal.points, rules_.longest * rules_.sample, 0.0};
        return;
      }
  }

  // Errors of the points and joints where the hand ends.
  End foresee(const Goal& given, const Vector& margins, const std::vector<Vector>& via) {
    const Motion motion = ik_.motion;
    Goal goal = given;
    goal.postures.resize(1);
    Result result;
    for (const Vector& posture : via) {
      const Goal towards = pulled(goal, posture);
      for (int k = 0; k < rules_.longest; ++k) {
        ik_.solve(towards, rules_.sample, margins, 1.0, result);
        if (is_at(posture)) break;
      }
    }
    for (int k = 0; k < rules_.samples; ++k) {
      ik_.solve(goal, rules_.sample, margins, 1.0, result);
      double most = 0.0;
      for (const double x : result.displacement) most = std::max(most, std::abs(x));
      if (most < rules_.settled) break;
    }
    End end{errors(goal, result), joints()};
    ik_.motion = motion;
    return end;
  }

  void start_from(const Vector& posture) {
    Vector away(ik_.tree.size, 0.0);
    const Vector now = joints();
    for (size_t j = 0; j < now.size(); ++j)
      away[ik_.tree.joint_columns[j]] = is_finger_[j] * (posture[j] - now[j]);
    ik_.at.displace(ik_.motion.q.data(), away.data());
    const Vector still(ik_.tree.size, 0.0);
    ik_.motion = {ik_.at.q, still, 1.0, still};
  }

  Goal pulled(const Goal& goal, const Vector& posture) const {
    Goal towards = goal;
    towards.postures = {{rules_.pull, posture, is_finger_}};
    return towards;
  }

  // How far the farthest target is from where the detour was looked for.
  double moved_by(const Goal& goal) const {
    double most = detour_.points.empty() ? kInfinity : 0.0;
    for (size_t k = 0; k < detour_.points.size(); ++k)
      most = std::max(most, norm(goal.points[k] - detour_.points[k]));
    return most;
  }

  bool is_at(const Vector& posture) const {
    double most = 0.0;
    for (size_t j = 0; j < posture.size(); ++j)
      most = std::max(most, is_finger_[j] * std::abs(ik_.motion.q[ik_.tree.q_indices[j]] - posture[j]));
    return most < rules_.reached;
  }

  Vector joints() const {
    Vector found;
    for (const int i : ik_.tree.q_indices) found.push_back(ik_.motion.q[i]);
    return found;
  }

  Vector errors(const Goal& goal, const Result& result) const {
    Vector found;
    for (size_t k = 0; k < goal.points.size(); ++k)
      found.push_back(ik_.weights.points[k] * norm(goal.points[k] - result.points[k]));
    return found;
  }

  static double largest(const Vector& errors) {
    return errors.empty() ? 0.0 : *std::max_element(errors.begin(), errors.end());
  }

  bool is_nearer(const Vector& errors, const Vector& ahead) const {
    bool is_any = false;
    double squares = 0.0, squares_ahead = 0.0;
    for (size_t k = 0; k < errors.size(); ++k) {
      is_any |= ahead[k] > rules_.away && errors[k] < rules_.of_point * ahead[k];
      squares += errors[k] * errors[k];
      squares_ahead += ahead[k] * ahead[k];
    }
    return is_any && squares < rules_.of_all * squares_ahead;
  }
};

// Move the hand for one sample, by a detour if its options allow any.
inline void seek(Ik& ik, const Goal& goal, double dt, const Vector& margins, double speed,
                  Result& result) {
  if (ik.detour_rules)
    Detours(ik).solve(goal, dt, margins, speed, result);
  else
    ik.solve(goal, dt, margins, speed, result);
}

}  // namespace handmap
