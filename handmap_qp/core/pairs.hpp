// Pairs of shapes that are kept apart: see handmap_qp/ik/collision.py, whose names these are.
#pragma once

#include <cstring>
#include <limits>
#include <memory>
#include <vector>

#include "limits.hpp"
#include "shapes.hpp"
#include "tree.hpp"

namespace handmap {

constexpr double kKept = 2e-4;
constexpr int kMostPoints = 30;
constexpr double kGain = 0.85;
constexpr double kNear = 0.001, kApproach = 0.5;
constexpr double kExpected = 0.25;
constexpr double kCleared = 5e-4;

// One number for some coordinates of the tangent space.
struct Sparse {
  std::vector<int> columns;
  Vector values;
  double dot(const double* x) const {
    double sum = 0.0;
    for (size_t k = 0; k < columns.size(); ++k) sum += values[k] * x[columns[k]];
    return sum;
  }
};

struct Body {
  int joint;
  Pose placement;
  Shape shape;
  Vec3 centre;  // of its bounding ball, in the joint's frame
  double radius = 0.0;
};

struct Pair {
  int first, second;
  Sparse levers, turns;
  Sparse signs;  // 1 where a coordinate moves the first shape, -1 where it moves the second
};

// How far a body reaches along a direction in its joint's axes, from the joint.
inline double reach_of(const Body& body, const Vec3& d) {
  return dot(d, body.placement.p) + reach(body.shape, tmul(body.placement.R, d));
}

// What never changes of the pairs of a hand.
struct PairBounds {
  std::vector<Body> bodies;
  std::vector<Pair> pairs;
  std::vector<size_t> order;  // of the pairs, by their joints
  std::vector<Body> boxes;    // around all shapes of each joint, that of the world first

  std::pair<int, int> joints(size_t k) const {
    return {bodies[pairs[k].first].joint, bodies[pairs[k].second].joint};
  }

  void finish() {
    int last = -1;
    for (const Body& body : bodies) last = std::max(last, body.joint);
    for (int j = -1; j <= last; ++j) boxes.push_back(box(j));
    for (size_t k = 0; k < pairs.size(); ++k) order.push_back(k);
    std::stable_sort(order.begin(), order.end(),
                     [this](size_t a, size_t b) { return joints(a) < joints(b); });
  }

 private:
  Body box(int joint) const {
    Vec3 least, most;
    for (int i = 0; i < 3; ++i) {
      Vec3 d;
      d[i] = 1.0;
      double low = kInfinity, high = -kInfinity;
      for (const Body& body : bodies)
        if (body.joint == joint) {
          high = std::max(high, reach_of(body, d));
          low = std::min(low, -reach_of(body, -d));
        }
      least[i] = low;
      most[i] = high;
    }
    const Vec3 centre = 0.5 * (least + most);
    return {joint, {{}, centre}, make_box(0.5 * (most - least)), centre};
  }
};

// Most pairs are far apart, so few are measured. Three lower bounds of a distance come first:
//
// - what was last known of it, less what the joints have turned since times levers;
// - how far the shapes are apart along the direction that parted them last;
// - both of these for the boxes around all shapes of two joints, for all their pairs at once.
//
// Inside, pairs are counted in the order of their joints, and in rows and margins as they came.
class Pairs {
 private:
  const std::shared_ptr<const PairBounds> bounds_;

 public:
  const std::vector<Body>& bodies;
  double margin = 0.0, horizon = kInfinity;

  Pairs(const Tree& tree, std::shared_ptr<const PairBounds> bounds)
      : bounds_(std::move(bounds)), bodies(bounds_->bodies), tree_(tree), middle_(tree) {
    const PairBounds& all = *bounds_;
    stamps_.assign(size(), -1);
    found_.resize(size());
    warm_.resize(size());
    keys_.assign(size(), -kInfinity);
    group_of_.resize(size());
    for (size_t k = 0; k < size(); ++k) {
      const auto [a, b] = all.joints(all.order[k]);
      if (k == 0 || all.joints(all.order[k - 1]) != std::make_pair(a, b))
        groups_.push_back({k, k, {&all.boxes[a + 1], &all.boxes[b + 1], groups_.size(), {}}});
      ++groups_.back().end;
      group_of_[all.order[k]] = groups_.size() - 1;
      partings_.push_back(
          {&bodies[pair(k).first], &bodies[pair(k).second], groups_.size() - 1, {}});
    }
    const size_t count = groups_.size();
    group_keys_.assign(count, -kInfinity);
    group_margins_.assign(count, 0.0);
    so_far_.assign(count, 0.0);
    for (Group& group : groups_) set_levers(group);
  }
  Pairs(const Pairs&) = delete;

  size_t size() const { return bounds_->pairs.size(); }

  // Rows of the pairs that may come to their margin in the next displacement, where the robot is.
  void rows(const Placed& at, double dt, const Vector& margins, const Vector& last, Rows& rows) {
    go_to(at);
    const int n = tree_.size;
    const double reach = std::max(
        std::min(horizon == kInfinity ? kInfinity : kNear + kApproach * dt, horizon), kKept);
    const auto within = [reach](double travel) {
      return reach < kInfinity ? std::min(kNear + kExpected * travel, reach) : reach;
    };
    moved_.resize(tree_.nv);
    tree_.expand(last.data(), moved_.data());
    for (const Joint& joint : tree_.joints)  // a floating wrist moves no pair
      if (joint.kind == JointKind::floating) std::fill_n(moved_.begin() + joint.v, 6, 0.0);
    travel_along(moved_.data());
    set_margins(margins);
    near_.clear();
    const auto farthest_of = [&](size_t g) { return group_margins_[g] + within(travels_[g]); };
    const auto is_far = [&](size_t g) {
      return raised(at, groups_[g].parting, group_keys_[g]) > farthest_of(g);
    };
    visit(farthest_of, is_far, [&](size_t k) {
      const size_t place = bounds_->order[k], g = partings_[k].group;
      const bool is_known = stamps_[k] == stamp_;
      const double kept = margins_[place];
      if (!is_known && raised(at, partings_[k], keys_[k]) > kept + within(travels_[g])) return;
      const double farthest = kept + within(travel_of(k));
      if (!is_known && keys_[k] - so_far_[g] > farthest) return;
      if (found(at, k).distance <= farthest) near_.push_back({place, k});
    });
    std::sort(near_.begin(), near_.end());
    rows.count = static_cast<int>(near_.size());
    rows.G.assign(near_.size() * n, 0.0);
    rows.h.clear();
    row_pairs_.clear();
    double* row = rows.G.data();
    for (const auto& [place, k] : near_) {
      const Found& found = found_[k];
      linearise(at, k, found.normal, found.point, row);
      row += n;
      rows.h.push_back(kGain * (found.distance - margins_[place]));
      row_pairs_.push_back(static_cast<int>(place));
    }
  }

  // Whether no pair touches on a straight path from where the robot is to `end`, along a step of all
  // coordinates.
  bool is_clear(const Placed& at, const double* step, const Placed& end) {
    go_to(at);
    travel_along(step);
    lows_.clear();
    ends_.clear();
    parts_.clear();
    met_.clear();
    bool is_clear = true;
    const auto farthest_of = [&](size_t g) { return kKept + travels_[g]; };
    const auto is_far = [&](size_t g) {
      Group& group = groups_[g];
      group.bend = pair(group.begin).turns.dot(turned_.data());  // as of all its pairs
      return stays_apart(at, end, group.parting, group_keys_[g], travels_[g]);
    };
    visit(farthest_of, is_far, [&](size_t k) {
      const double travel = travel_of(k);
      if (stays_apart(at, end, partings_[k], keys_[k], travel)) return;
      const Found &before = found(at, k), after = found_at(end, k);
      if (before.distance > kKept + travel) return;
      ends_.push_back({k, after});
      // On a path from a to b, the distance is never below (a + b - travel) / 2.
      if (!(before.distance > 0.0 && before.distance + after.distance - travel < kKept)) return;
      const double kept = std::min(before.distance, kKept);
      if (after.distance < kept) meet(at, end, k, after);
      is_clear &= after.distance >= kept;
      parts_.push_back({0.0, 1.0, k, kept, before, after});
    });
    return is_clear && halve(at, step);
  }

  // What met on the last path, where it began: see collision.ShapeDistances.met_on.
  bool has_met() const { return !met_.empty(); }

  // The pair of those that is nearest where the path began, as it came.
  int nearest_met() const {
    const auto is_nearer = [](const Met& a, const Met& b) {
      return a.found.distance < b.found.distance;
    };
    return static_cast<int>(place(std::min_element(met_.begin(), met_.end(), is_nearer)->pair));
  }

  // The pair of a row, as it came; -1 of none.
  int pair_of(int row) const { return row < 0 ? -1 : row_pairs_[row]; }

  // Add the rows of what met; see limits.Gate.joined.
  void add_met(const Placed& at, Rows& rows) {
    const int n = tree_.size;
    std::sort(met_.begin(), met_.end(),
              [this](const Met& a, const Met& b) { return place(a.pair) < place(b.pair); });
    rows.G.resize((rows.h.size() + met_.size()) * n, 0.0);
    double* row = rows.G.data() + rows.h.size() * n;
    for (const Met& met : met_) {
      linearise(at, met.pair, met.found.normal, met.found.point, row);
      row += n;
      rows.h.push_back(kGain * (met.found.distance - kCleared));
      row_pairs_.push_back(static_cast<int>(place(met.pair)));
    }
    rows.count = static_cast<int>(rows.h.size());
  }

  // The robot goes on to `at`. If that is where the last path ended but for a floating wrist, what
  // was found there moves with the wrist.
  void arrive(const Placed& at, const Placed& end) {
    if (q_.empty() || longest(at.q, end.q) != 0.0) return;
    const Pose moved = tree_.is_floating ? at.pose(0) * inverse(end.pose(0)) : Pose{};
    for (size_t g = 0; g < groups_.size(); ++g) so_far_[g] += travels_[g];
    q_ = at.q;
    ++stamp_;
    for (const Low& low : lows_) *low.key = std::max(*low.key, low.distance + so_far_[low.group]);
    for (const auto& [k, found] : ends_)
      know(at, k, {found.distance, moved.R * found.normal, moved * found.point});
  }

 private:
  size_t place(size_t k) const { return bounds_->order[k]; }
  const Pair& pair(size_t k) const { return bounds_->pairs[place(k)]; }

  // Two bodies and a unit direction: their distance is at least that along the direction.
  struct Parting {
    const Body *a, *b;
    size_t group;
    Vec3 axis;           // in the axes of the first one's joint; 0 at the beginning
    double reach = 0.0;  // of the first one along it, from the joint

    void set(const Vec3& direction) {
      axis = direction;
      reach = reach_of(*a, axis);
    }
  };
  // The pairs of the shapes of two joints: a range of all, as they are sorted.
  struct Group {
    size_t begin, end;
    Parting parting;           // of the boxes around all shapes of the joints
    std::vector<int> columns = {};  // the coordinates that move any of its pairs
    Vector levers = {};  // the largest of its pairs for each of them, then those of each pair
    double bend = 0.0;   // along the path that is looked at
  };
  // A lower bound of a distance where the last path ends, and the key that it may raise.
  struct Low {
    double* key;
    size_t group;
    double distance;
  };
  struct Part {
    double low, high;
    size_t pair;
    double kept;
    Found before, after;
  };

  // Points of a pair that met, where the path began.
  struct Met {
    size_t pair;
    Found found;  // along the normal, and of the second shape
  };

  // The largest difference of a joint's position; a floating wrist moves no pair.
  double longest(const Vector& a, const Vector& b) const {
    double most = 0.0;
    for (const Joint& joint : tree_.joints)
      if (joint.kind != JointKind::floating)
        most = std::max(most, std::abs(a[joint.q] - b[joint.q]));
    return most;
  }

  void go_to(const Placed& at) {
    if (q_ == at.q) return;
    if (!q_.empty()) {
      moved_.assign(tree_.nv, 0.0);  // a floating wrist moves no pair
      for (const Joint& joint : tree_.joints)
        if (joint.kind != JointKind::floating)
          moved_[joint.v] = std::abs(at.q[joint.q] - q_[joint.q]);
      for (size_t g = 0; g < groups_.size(); ++g)
        so_far_[g] += travel(groups_[g], groups_[g].levers.data(), moved_);
    }
    q_ = at.q;
    ++stamp_;
  }

  // Keep the levers of a group's pairs in one place.
  void set_levers(Group& group) {
    for (int c = 0; c < tree_.nv; ++c)
      for (size_t k = group.begin; k < group.end; ++k)
        if (lever(k, c) != 0.0) {
          group.columns.push_back(c);
          break;
        }
    for (const int c : group.columns) {
      double most = 0.0;
      for (size_t k = group.begin; k < group.end; ++k) most = std::max(most, lever(k, c));
      group.levers.push_back(most);
    }
    for (size_t k = group.begin; k < group.end; ++k)
      for (const int c : group.columns) group.levers.push_back(lever(k, c));
  }

  double lever(size_t k, int column) const {
    const Sparse& levers = pair(k).levers;
    for (size_t i = 0; i < levers.columns.size(); ++i)
      if (levers.columns[i] == column) return levers.values[i];
    return 0.0;
  }

  // The sum of turns times levers, of the largest ones of a group or of those of a pair.
  static double travel(const Group& group, const double* levers, const Vector& turned) {
    double sum = 0.0;
    for (const int c : group.columns) sum += *levers++ * turned[c];
    return sum;
  }
  double travel_of(size_t k) const {
    const Group& group = groups_[partings_[k].group];
    const size_t row = (1 + k - group.begin) * group.columns.size();
    return travel(group, group.levers.data() + row, turned_);
  }

  // Set `turned_` and `travels_` to those of a step.
  void travel_along(const double* step) {
    bool is_same = !turned_.empty();
    turned_.resize(tree_.nv);
    for (int c = 0; c < tree_.nv; ++c) {
      const double turn = std::abs(step[c]);
      is_same &= turn == turned_[c];
      turned_[c] = turn;
    }
    if (is_same) return;
    travels_.resize(groups_.size());
    for (size_t g = 0; g < groups_.size(); ++g)
      travels_[g] = travel(groups_[g], groups_[g].levers.data(), turned_);
  }

  // Take in the margins of all pairs. From sample to sample, they change at few places.
  void set_margins(const Vector& margins) {
    constexpr size_t kBlock = 64;
    if (margins.empty() && same_.empty()) same_.assign(size(), margin);
    const Vector& given = margins.empty() ? same_ : margins;
    changed_.assign(groups_.size(), margins_.empty());
    margins_.resize(size());
    for (size_t from = 0; from < size(); from += kBlock) {
      const size_t count = std::min(kBlock, size() - from);
      if (!std::memcmp(&margins_[from], &given[from], count * sizeof(double))) continue;
      for (size_t i = from; i < from + count; ++i) {
        if (margins_[i] != given[i]) changed_[group_of_[i]] = true;
        margins_[i] = given[i];
      }
    }
    for (size_t g = 0; g < groups_.size(); ++g) {
      if (!changed_[g]) continue;
      double& most = group_margins_[g] = -kInfinity;
      for (size_t k = groups_[g].begin; k < groups_[g].end; ++k)
        most = std::max(most, margins_[bounds_->order[k]]);
    }
  }

  // Visit the pairs that may be within the distance of their group, but for groups that are far.
  //
  // Keys are lower bounds of distances, plus the group's travel since the beginning. Comparisons are
  // written so that NaN visits all.
  template <class FarthestOf, class IsFar, class Visit>
  void visit(const FarthestOf& farthest_of, const IsFar& is_far, const Visit& visit_pair) {
    for (size_t g = 0; g < groups_.size(); ++g) {
      const double so_far = so_far_[g], farthest = farthest_of(g);
      if (group_keys_[g] - so_far > farthest || is_far(g)) continue;
      Group& group = groups_[g];
      size_t nearest = group.begin;
      double least = kInfinity;
      for (size_t k = group.begin; k < group.end; ++k) {
        double key = keys_[k];
        if (!(key - so_far > farthest)) {
          visit_pair(k);
          key = keys_[k];
        }
        if (key < least) {
          least = key;
          nearest = k;
        }
      }
      group_keys_[g] = std::max(group_keys_[g], least);
      group.parting.set(partings_[nearest].axis);
    }
  }

  // The distance of two bodies along their axis; at first, the axis is the line of their centres.
  double gap(const Placed& at, Parting& parting) const {
    const Body &a = *parting.a, &b = *parting.b;
    const Pose &pose_a = at.pose(a.joint), &pose_b = at.pose(b.joint);
    if (parting.axis.x == 0.0 && parting.axis.y == 0.0 && parting.axis.z == 0.0) {
      const Vec3 apart = tmul(pose_a.R, pose_b * b.centre - pose_a * a.centre);
      const double length = norm(apart);
      if (!(length > 0.0)) return -kInfinity;
      parting.set((1.0 / length) * apart);
    }
    const Vec3 axis = pose_a.R * parting.axis, axis_b = tmul(pose_b.R, axis);
    return dot(axis, pose_b.p - pose_a.p) - parting.reach - reach_of(b, -axis_b);
  }

  // Raise the key of two bodies to their distance along their axis where the robot is, and return the
  // lower bound that it is then.
  double raised(const Placed& at, Parting& parting, double& key) const {
    const double so_far = so_far_[parting.group];
    key = std::max(key, gap(at, parting) + so_far);
    return key - so_far;
  }

  // Whether two bodies are shown to stay apart by KEPT on the path to `end`, without a measurement.
  //
  // The proof in collision.py holds for any two directions at the ends, here the axis carried along.
  bool stays_apart(const Placed& at, const Placed& end, Parting& parting, double& key,
                   double travel) {
    const double enough = kKept + travel, so_far = so_far_[parting.group];
    if (key - so_far > enough) return true;
    const double after = gap(end, parting);
    lows_.push_back({&key, parting.group, after});
    // On a path from a to b, the distance is never below (a + b - travel) / 2.
    if (key - so_far + after >= enough) return true;
    const double before = gap(at, parting);
    key = std::max(key, before + so_far);
    const double low = key - so_far, nearest = std::min(before, after);
    if (low > enough || low + after >= enough) return true;
    if (nearest < kKept) return false;
    const int joint = parting.a->joint;
    const Vec3 change = end.pose(joint).R * parting.axis - at.pose(joint).R * parting.axis;
    return nearest - dip(change, 1.0, travel, groups_[parting.group].bend) >= kKept;
  }

  // How far below its ends a distance may be on a part of a path; see handmap_qp/ik/collision.py.
  static double dip(const Vec3& change, double length, double travel, double bend) {
    return 0.125 * (2.0 * norm(change) + length * bend) * length * travel;
  }

  void know(const Placed& at, size_t k, const Found& found) {
    stamps_[k] = stamp_;
    found_[k] = found;
    partings_[k].set(tmul(at.pose(bodies[pair(k).first].joint).R, found.normal));
    keys_[k] = found.distance + so_far_[partings_[k].group];
  }

  // The distance of a pair where the robot is.
  const Found& found(const Placed& at, size_t k) {
    if (stamps_[k] != stamp_) know(at, k, found_at(at, k));
    return found_[k];
  }

  Found found_at(const Placed& at, size_t k) {
    const Body &a = bodies[pair(k).first], &b = bodies[pair(k).second];
    return measure(a.shape, at.pose(a.joint) * a.placement, b.shape,
                   at.pose(b.joint) * b.placement, warm_[k]);
  }

  // See collision.ShapeDistances._meetings.
  void meet(const Placed& at, const Placed& there, size_t k, const Found& known) {
    const int a = bodies[pair(k).first].joint, b = bodies[pair(k).second].joint;
    const Pose moved_a = at.pose(a) * inverse(there.pose(a));
    const Pose moved_b = at.pose(b) * inverse(there.pose(b));
    const Vec3 normal = moved_a.R * known.normal;
    const Vec3 second = moved_b * (known.point + known.distance * known.normal);
    met_.push_back({k, {dot(normal, second - moved_a * known.point), normal, second}});
  }

  void linearise(const Placed& at, size_t k, const Vec3& normal, const Vec3& point,
                 double* row) const {
    const Vec3 moment = cross(point, normal);
    const Sparse& signs = pair(k).signs;
    for (size_t i = 0; i < signs.columns.size(); ++i) {
      const int c = signs.columns[i];
      const Twist& twist = at.columns[c];
      row[tree_.leader[c]] += tree_.factor[c] * signs.values[i] *
                              (dot(normal, twist.v) + dot(moment, twist.w));
    }
  }

  // Halve the parts of a path until each is shown to be clear, or a point of it is too near.
  bool halve(const Placed& at, const double* step) {
    int taken = 0;
    moved_.resize(tree_.nv);
    reached_.resize(tree_.nq);
    while (!parts_.empty()) {
      further_.clear();
      double at_low = -1.0;
      for (const Part& part : parts_) {
        const double length = part.high - part.low;
        const double travel = travel_of(part.pair);
        const double bend = groups_[partings_[part.pair].group].bend;
        const double nearest = std::min(part.before.distance, part.after.distance);
        const Vec3 change = part.after.normal - part.before.normal;
        if (!(nearest - dip(change, length, travel, bend) < 0.5 * part.kept)) continue;
        const double middle = 0.5 * (part.low + part.high);
        // All parts of one interval are halved at one point.
        if (at_low != part.low) {
          if (taken == kMostPoints || has_met()) return false;
          ++taken;
          at_low = part.low;
          for (int c = 0; c < tree_.nv; ++c) moved_[c] = middle * step[c];
          tree_.integrate(at.q.data(), moved_.data(), reached_.data());
          middle_.place(reached_.data());
        }
        const Found between = found_at(middle_, part.pair);
        if (between.distance < part.kept) meet(at, middle_, part.pair, between);
        further_.push_back({part.low, middle, part.pair, part.kept, part.before, between});
        further_.push_back({middle, part.high, part.pair, part.kept, between, part.after});
      }
      if (has_met()) return false;
      std::stable_sort(further_.begin(), further_.end(),
                       [](const Part& a, const Part& b) { return a.low < b.low; });
      std::swap(parts_, further_);
    }
    return true;
  }

  const Tree& tree_;
  Placed middle_;
  Vector q_;  // where the robot is
  long stamp_ = 0;
  std::vector<long> stamps_;   // where each pair was found last
  std::vector<Found> found_;
  Vector keys_;
  std::vector<Group> groups_;
  Vector group_keys_, group_margins_, so_far_, travels_;
  Vector margins_, same_;  // in the order in which pairs came
  std::vector<size_t> group_of_;  // likewise
  std::vector<char> changed_;
  std::vector<Parting> partings_;
  std::vector<std::pair<size_t, size_t>> near_;
  std::vector<int> row_pairs_;
  std::vector<Warm> warm_;
  std::vector<Low> lows_;
  std::vector<std::pair<size_t, Found>> ends_;
  Vector turned_, moved_, reached_;
  std::vector<Part> parts_, further_;
  std::vector<Met> met_;
};

}  // namespace handmap
