// Pairs of shapes that are kept apart: rows of the QP, and bounds of distances on a path.
//
// For a pair of shapes a, b at the signed distance d, with the unit normal n from a to b,
//
//     d(q + dq) ~ d + n^T (J_b - J_a) dq >= margin
//
// becomes
//
//     -n^T (J_b - J_a) dq <= gain (d - margin)
//
// with J_a and J_b the Jacobians of the nearest points. Both lie on one line along n, so the wrench
// (n, p x n) of either does for both. The first order is an approximation: a shape that turns by an
// angle x at a radius r may come r x^2 / 2 closer than the row says. The margin is for that, and
// the gate (gate.hpp) checks the whole displacement afterwards.
//
// Rows are linearised where a sample starts, and hold for its whole displacement: a later iteration of
// the QP has what the ones before it left. Where there is a horizon, a pair gets a row if another step
// like the last one may bring it to its margin.
//
// A point of a shape moves by at most its lever times the turn of a joint. So the distance of a pair
// changes by at most its `travel` on a straight path in joint space, the sum of levers times turns.
//
// Between two points of a path at which a distance is `a` and `b`, it is never below
//
//     (a + b - travel) / 2.
//
// Near pairs need more. Let n go from the normal at the one point to that at the other in proportion
// to the path, in the axes of the last joint that moves both shapes. Two convex shapes are at least as
// far apart as along n, which has no more than unit length. For each two points of theirs, the second
// derivative of that is at most `(2 |change of n| + S) travel`, with S the sum of the turns between
// the shapes. In those axes n changes by at most its change in the world and the sum C of the turns
// that both shapes share. So the distance is never below
//
//     min(a, b) - (2 |change of n in the world| + 2 C + S) travel / 8.
//
// For n any two directions will do, and what the shapes are apart along them. So a direction that stays
// the same in the world, such as the normal at either end, often shows that a path is clear before its
// other end, or a point between, is measured.
//
// Where that does not suffice, the path is halved, until it does or a point of it is too near.
//
// There the rows were wrong: a link that lies flat on another one touches it next wherever it turns
// to, and a row knows one pair of points. The points that meet there are then kept apart too. With the
// normal n carried by the first shape, points p of it and r of the second one, as they are at the
// start,
//
//     -n^T (J_b - J_a)(r) dq <= gain (n^T (r - p) - margin).
//
// For the same reason the end of the QP's step is measured before that. Pairs that have rows, and that
// the step brings nearer and within their margin, get such rows of the points there, with their
// margin, and the QP is solved again, a few times at most. Without them, links that are pressed flat
// on each other rock from corner to corner for ever.
//
// Pairs may yield (handmap_core/hands/contact_yield.py): commanded links overlap by as much as presses
// with a given force. Then all of the above counts from that overlap on, as of the posture where the
// sample starts. A pair that overlaps by more, because the joints have moved since, must not come
// nearer, and its row parts it.
#pragma once

#include <cstring>
#include <limits>
#include <memory>
#include <vector>

#include "limits.hpp"
#include "shapes.hpp"
#include "tree.hpp"

namespace handmap {

// Pairs do not come nearer than this, or than they are at the start, where a path is measured; and not
// nearer than half of it between [m].
constexpr double kKept = 2e-4;
// Points of a path that are measured, at most; a path that needs more counts as not clear.
constexpr int kMostPoints = 30;
// Part of the free distance that one step may use.
constexpr double kGain = 0.85;
// A pair has come nearer if its distance is shorter by this [m].
constexpr double kNearer = 1e-6;
// With a horizon, pairs get rows up to this distance beyond their margin [m], and as much farther as they
// approach in a sample at this speed [m/s].
constexpr double kNear = 0.001, kApproach = 0.5;
// Share of the last displacement's travel by which a pair is expected to come nearer.
constexpr double kExpected = 0.25;
// Distance that pairs keep which met on a displacement, where it is planned again [m].
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

// Pairs that are farther apart than this count as not touching [m].
constexpr double kYieldNear = 1e-3;

// How far pairs may overlap in commands: see handmap_core/hands/contact_yield.py. A model.
struct ContactYield {
  static constexpr const char* kName = "YieldModel";
  Vector forces, depths;         // of each pair, as they came
  Vector compliances, torques;  // of each active coordinate
  template <class Visitor>
  void fields(Visitor& visit) {
    visit("forces", forces);
    visit("depths", depths);
    visit("compliances", compliances);
    visit("torques", torques);
  }
  bool is_empty() const { return forces.empty(); }
};

// A box around all shapes of a joint, along its axes.
struct JointBox {
  int joint;
  Vec3 centre, half;
};

// How far a body or a box reaches along a direction in its joint's axes, from the joint.
inline double reach_of(const Body& body, const Vec3& d) {
  return dot(d, body.placement.p) + reach(body.shape, tmul(body.placement.R, d));
}
inline double reach_of(const JointBox& box, const Vec3& d) {
  const Vec3& half = box.half;
  return dot(d, box.centre) +
         (half.x * std::abs(d.x) + half.y * std::abs(d.y) + half.z * std::abs(d.z));
}

// What never changes of the pairs of a hand.
struct PairBounds {
  std::vector<Body> bodies;
  std::vector<Pair> pairs;
  std::vector<size_t> order;    // of the pairs, by their joints
  std::vector<JointBox> boxes;  // of each joint, that of the world first

  std::pair<int, int> joints(size_t k) const {
    return {bodies[pairs[k].first].joint, bodies[pairs[k].second].joint};
  }

  // Reject a hand that these are not the pairs of.
  void expect_hand(const Tree& tree) const {
    for (const Body& body : bodies)
      expect_that(tree.has_joint(body.joint), "PairsModel.bodies: joint", "a joint of the hand");
    for (const Pair& pair : pairs)
      for (const Sparse* each : {&pair.levers, &pair.turns, &pair.signs})
        expect_below("PairsModel: columns of levers, turns and signs", each->columns,
                     static_cast<size_t>(tree.nv));
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
  JointBox box(int joint) const {
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
    return {joint, 0.5 * (least + most), 0.5 * (most - least)};
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
  ContactYield yielding;
  std::int64_t queries = 0;  // number of distances that were measured, as a measure of work

  Pairs(const Tree& tree, std::shared_ptr<const PairBounds> bounds)
      : bounds_(std::move(bounds)), bodies(bounds_->bodies), tree_(tree), middle_(tree) {
    const PairBounds& all = *bounds_;
    stamps_.assign(size(), -1);
    found_.resize(size());
    warm_.resize(size());
    ends_known_.resize(size());
    end_poses_.resize(bounds_->boxes.size());
    end_changes_.assign(bounds_->boxes.size(), -1);
    keys_.assign(size(), -kInfinity);
    group_of_.resize(size());
    make_chains();
    for (size_t k = 0; k < size(); ++k) {
      const auto [a, b] = all.joints(all.order[k]);
      if (k == 0 || all.joints(all.order[k - 1]) != std::make_pair(a, b)) {
        groups_.push_back({k, k, {&all.boxes[a + 1], &all.boxes[b + 1], groups_.size(), {}}});
        group_ends_.push_back(ends_of(bodies.size() + a + 1, bodies.size() + b + 1));
      }
      ++groups_.back().end;
      group_of_[all.order[k]] = groups_.size() - 1;
      partings_.push_back(
          {&bodies[pair(k).first], &bodies[pair(k).second], groups_.size() - 1, {}});
      pair_ends_.push_back(ends_of(pair(k).first, pair(k).second));
    }
    group_keys_.assign(groups_.size(), -kInfinity);
    group_margins_.assign(groups_.size(), 0.0);
  }
  Pairs(const Pairs&) = delete;

  // Make room for the usual rows, and for the proofs of a path.
  void reserve() {
    const size_t nv = static_cast<size_t>(tree_.nv), near = std::min(size(), kUsualRows);
    near_.reserve(size());
    for (Vector* each : {&margins_, &same_}) each->reserve(size());
    changed_.reserve(groups_.size());
    box_lows_.reserve(groups_.size());
    // A pair may be looked at twice on a path.
    lows_.reserve(2 * size());
    ends_.reserve(size());
    for (std::vector<Part>* each : {&parts_, &further_}) each->reserve(2 * near);
    met_.reserve(near);
    row_pairs_.reserve(kUsualRows);
    for (Vector* each : {&overlaps_, &touching_}) each->reserve(near);
    if (!yielding.is_empty()) touching_rows_.reserve(near * nv);
    for (Vector* each : {&turned_, &moved_, &own_row_}) each->reserve(nv);
    for (Vector* each : {&q_, &reached_}) each->reserve(static_cast<size_t>(tree_.nq));
    moved_sums_.reserve(so_far_.size());
    expansion_.reserve();
  }

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
    const auto farthest_of = [&](size_t g) { return group_margins_[g] + within(travel_of_group(g)); };
    const auto is_far = [&](size_t g) {
      return raised(at, groups_[g].parting, group_keys_[g]) > farthest_of(g);
    };
    visit(farthest_of, is_far, [&](size_t k) {
      const size_t place = bounds_->order[k], g = partings_[k].group;
      const bool is_known = stamps_[k] == stamp_;
      const double kept = margins_[place];
      if (!is_known && raised(at, partings_[k], keys_[k]) > kept + within(travel_of_group(g)))
        return;
      const double farthest = kept + within(travel_of(k));
      if (!is_known && keys_[k] - so_far(g) > farthest) return;
      if (found(at, k).distance <= farthest) near_.push_back({place, k});
    });
    std::sort(near_.begin(), near_.end());
    rows.count = static_cast<int>(near_.size());
    rows.G.assign(near_.size() * n, 0.0);
    rows.h.clear();
    row_pairs_.clear();
    double* row = rows.G.data();
    for (const auto& [place, k] : near_) {
      linearise(at, k, found_[k].normal, found_[k].point, row);
      row += n;
    }
    find_touching(rows.G);
    overlaps_.clear();
    row = rows.G.data();
    for (const auto& [place, k] : near_) {
      overlaps_.push_back(overlap_by(row, place));
      row += n;
      rows.h.push_back(kGain * (found_[k].distance - (margins_[place] - overlaps_.back())));
      row_pairs_.push_back(static_cast<int>(place));
    }
  }

  // Let proofs of paths measure this many distances from now on. One that needs more fails, so that a
  // sample costs no more wherever the hand is, on every computer.
  void grant(std::int64_t distances) { most_queries_ = queries + distances; }
  bool is_spent() const { return queries >= most_queries_; }

  // Whether no pair touches on a straight path from where the robot is to `end`, along a step of all
  // coordinates.
  bool is_clear(const Placed& at, const double* step, const Placed& end) {
    go_to(at);
    travel_along(step);
    go_to_end(end);
    box_lows_.clear();
    lows_.clear();
    ends_.clear();
    parts_.clear();
    met_.clear();
    bool is_clear = true;
    const auto farthest_of = [&](size_t g) { return kKept + travel_of_group(g); };
    const auto is_far = [&](size_t g) {
      return stays_apart(at, end, groups_[g].parting, group_keys_[g], travel_of_group(g));
    };
    visit(farthest_of, is_far, [&](size_t k) {
      const double travel = travel_of(k);
      if (is_spent()) {
        is_clear = false;
        return;
      }
      if (stays_apart(at, end, partings_[k], keys_[k], travel)) return;
      const bool is_new = stamps_[k] != stamp_;
      const Found& before = found(at, k);
      // Along the normal that was found, it may be shown after all.
      if (is_new && stays_apart(at, end, partings_[k], keys_[k], travel)) return;
      if (before.distance > kKept + travel) return;
      // Distances count from here on: 0, or what yields may overlap.
      const double floor = -overlap(at, k), room = before.distance - floor;
      if (!(room > 0.0 || yields(k))) return;
      Part part;
      part.pair = k;
      part.kept = room > 0.0 ? floor + std::min(room, kKept) : before.distance - kNearer;
      part.between = part.kept - 0.5 * (room > 0.0 ? std::min(room, kKept) : kKept);
      part.before = before;
      // The end is measured where neither the normal here nor the last one there shows enough.
      const double ahead = gap_along(end, k, before.normal);
      const bool is_shown_ahead = is_shown(before.distance, ahead, part);
      if (is_shown_ahead && ahead >= part.kept) return;
      const Vec3 last = end.pose(bodies[pair(k).first].joint).R * ends_known_[k].axis;
      const double there = gap_along(end, k, last);
      if (there >= part.kept && is_shown(gap_along(at, k, last), there, part)) return;
      part.after = found_at_end(end, k);
      const Found& after = part.after;
      ends_.push_back({k, after});
      // On a path from a to b, the distance is never below (a + b - travel) / 2.
      if (!(before.distance + after.distance - travel < kKept + 2.0 * floor)) return;
      if (after.distance < part.kept) meet(at, end, k, after);
      is_clear &= after.distance >= part.kept;
      if (is_shown_ahead || is_shown(after.distance, gap_along(at, k, after.normal), part)) return;
      parts_.push_back(part);
    });
    return is_clear && halve(at, step);
  }

  // Whether the end of a path brings pairs that have rows nearer, and within their margin.
  bool meets_at(const Placed& at, const double* step, const Placed& end) {
    travel_along(step);
    met_.clear();
    for (size_t r = 0; r < near_.size(); ++r) {
      const auto [place, k] = near_[r];
      const double kept = margins_[place] - overlaps_[r];
      const double nearest = std::min(found_[k].distance, kept) - kNearer;
      if (found_[k].distance - travel_of(k) > nearest) continue;
      // Shapes are at least as far apart as along any direction: the normal at the start, as it is in
      // the world, and as the first shape carries it.
      if (gap_along(end, k, found_[k].normal) >= nearest) continue;
      if (gap(end, partings_[k]) >= nearest) continue;
      const Found after = found_at(end, k);
      if (after.distance < nearest) meet(at, end, k, after);
    }
    return has_met();
  }

  // What met on the last path, where it began.
  bool has_met() const { return !met_.empty(); }

  // The pair of those that is nearest where the path began, as it came.
  int nearest_met() const {
    const auto is_nearer = [](const Met& a, const Met& b) {
      return a.found.distance < b.found.distance;
    };
    return static_cast<int>(place(std::min_element(met_.begin(), met_.end(), is_nearer)->pair));
  }

  // The pair of a row, as it came.
  int pair_of(int row) const { return row_pairs_[row]; }

  // Add the rows of what met, kept apart by their margins or by `kCleared`.
  void add_met(const Placed& at, bool by_margins, Rows& rows) {
    const int n = tree_.size;
    std::sort(met_.begin(), met_.end(),
              [this](const Met& a, const Met& b) { return place(a.pair) < place(b.pair); });
    rows.G.resize((rows.h.size() + met_.size()) * n, 0.0);
    double* row = rows.G.data() + rows.h.size() * n;
    for (const Met& met : met_) {
      const size_t own = place(met.pair);
      linearise(at, met.pair, met.found.normal, met.found.point, row);
      const double kept = (by_margins ? margins_[own] : kCleared) - overlap_by(row, own);
      row += n;
      rows.h.push_back(kGain * (met.found.distance - kept));
      row_pairs_.push_back(static_cast<int>(own));
    }
    rows.count = static_cast<int>(rows.h.size());
  }

  // The robot goes on to `at`. If that is where the last path ended but for a floating wrist, what
  // was found there moves with the wrist.
  void arrive(const Placed& at, const Placed& end) {
    if (q_.empty() || longest(at.q, end.q) != 0.0) return;
    const Pose moved = tree_.is_floating ? at.pose(0) * inverse(end.pose(0)) : Pose{};
    for (size_t i = 0; i < sums_.size(); ++i) so_far_[i] += sums_[i];
    q_ = at.q;
    ++stamp_;
    raise(box_lows_);
    raise(lows_);
    for (const auto& [k, found] : ends_)
      know(at, k, {found.distance, moved.R * found.normal, moved * found.point});
  }

 private:
  size_t place(size_t k) const { return bounds_->order[k]; }
  const Pair& pair(size_t k) const { return bounds_->pairs[place(k)]; }

  // Two bodies or boxes and a unit direction: their distance is at least that along the direction.
  template <class Thing>
  struct Parting {
    const Thing *a, *b;
    size_t group;
    Vec3 axis;           // in the axes of the first one's joint; 0 at the beginning
    double reach = 0.0;  // of the first one along it, from the joint
    int changes = 0;     // of the axis
    double gap = 0.0;    // how far both were apart along it, when the stamp was this
    long stamp = -1;

    void set(const Vec3& direction) {
      axis = direction;
      reach = reach_of(*a, axis);
      ++changes;
      stamp = -1;
    }
  };
  // The pairs of the shapes of two joints: a range of all, as they are sorted.
  struct Group {
    size_t begin, end;
    Parting<JointBox> parting;
  };
  // The coordinates that move a body, or a joint, from the root on, with a lever for each.
  struct Chain {
    const std::vector<int>* coordinates;
    Vector levers;
    size_t first;  // of its sums
  };
  // Of the sums of two chains, those of all coordinates that move one but not the other.
  struct Ends {
    size_t a, b;
    double of(const Vector& sums) const { return sums[a] + sums[b]; }
  };
  // How far two bodies or boxes are apart along their axis where the last path ends, and the key that it
  // may raise.
  template <class Thing>
  struct Low {
    double* key;
    Parting<Thing>* parting;
    int changes;  // of its axis, till then
    double gap;
  };
  struct Part {
    double low = 0.0, high = 1.0;
    size_t pair;
    double kept, between;  // at points that are measured, and between them
    Found before, after;
  };

  // What was found of a pair where a path ended, and the normal in the axes of the first one's joint.
  struct End {
    Found found;
    Vec3 axis;
    long path = -1;
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
      sum_along(moved_, moved_sums_);
      for (size_t i = 0; i < sums_.size(); ++i) so_far_[i] += moved_sums_[i];
    }
    q_ = at.q;
    ++stamp_;
  }

  // Make the chains of all bodies, and those of the joints with the largest levers of their bodies.
  //
  // The levers of a pair are those of its first shape for what moves that alone, and those of its
  // second one for the others.
  void make_chains() {
    const auto support = [this](int joint) { return joint < 0 ? &none_ : &tree_.supports[joint]; };
    std::vector<Vector> levers(bodies.size() + bounds_->boxes.size(), Vector(tree_.nv, 0.0));
    for (const Pair& pair : bounds_->pairs) {
      const std::vector<int>& moving = *support(bodies[pair.first].joint);
      for (size_t i = 0; i < pair.levers.columns.size(); ++i) {
        const int c = pair.levers.columns[i];
        const bool is_first = std::binary_search(moving.begin(), moving.end(), c);
        const int body = is_first ? pair.first : pair.second;
        for (const size_t which : {size_t(body), bodies.size() + bodies[body].joint + 1})
          levers[which][c] = std::max(levers[which][c], pair.levers.values[i]);
      }
    }
    size_t first = 0;
    for (size_t i = 0; i < levers.size(); ++i) {
      const bool is_body = i < bodies.size();
      const int joint = is_body ? bodies[i].joint : static_cast<int>(i - bodies.size()) - 1;
      chains_.push_back({support(joint), {}, first});
      for (const int c : *support(joint)) chains_.back().levers.push_back(levers[i][c]);
      first += chains_.back().levers.size() + 1;
    }
    sums_.assign(first, 0.0);
    so_far_.assign(first, 0.0);
  }

  Ends ends_of(size_t a, size_t b) const {
    const std::vector<int>&own = *chains_[a].coordinates, &other = *chains_[b].coordinates;
    const auto [end, end_other] =
        std::mismatch(own.begin(), own.end(), other.begin(), other.end());
    const size_t common = end - own.begin();
    return {chains_[a].first + common, chains_[b].first + common};
  }

  // Sum turns times levers along each chain, from each coordinate to the last.
  void sum_along(const Vector& turned, Vector& sums) const {
    sums.resize(so_far_.size());
    for (const Chain& chain : chains_) {
      double sum = sums[chain.first + chain.levers.size()] = 0.0;
      for (size_t i = chain.levers.size(); i-- > 0;) {
        sum += chain.levers[i] * turned[(*chain.coordinates)[i]];
        sums[chain.first + i] = sum;
      }
    }
  }

  // How much the distance of a pair, and that of any pair of a group, may change on the path.
  double travel_of(size_t k) const { return pair_ends_[k].of(sums_); }
  double travel_of_group(size_t g) const { return group_ends_[g].of(sums_); }
  // Likewise of a group since the beginning.
  double so_far(size_t g) const { return group_ends_[g].of(so_far_); }

  double bend_of(size_t k) const { return pair(k).turns.dot(turned_.data()); }

  // Set `turned_` and `sums_` to those of a step.
  void travel_along(const double* step) {
    bool is_same = !turned_.empty();
    turned_.resize(tree_.nv);
    for (int c = 0; c < tree_.nv; ++c) {
      const double turn = std::abs(step[c]);
      is_same &= turn == turned_[c];
      turned_[c] = turn;
    }
    if (!is_same) sum_along(turned_, sums_);
  }

  // Take in the margins of all pairs. From sample to sample, they change at few places.
  void set_margins(const Vector& margins) {
    constexpr size_t kBlock = 64;
    if (margins.empty() && same_.empty()) same_.assign(size(), margin);
    const Vector& given = margins.empty() ? same_ : margins;
    const bool is_first = margins_.empty();
    bool has_changed = is_first;
    changed_.assign(groups_.size(), is_first);
    margins_.resize(size());
    for (size_t from = 0; from < size(); from += kBlock) {
      const size_t count = std::min(kBlock, size() - from);
      if (!std::memcmp(&margins_[from], &given[from], count * sizeof(double))) continue;
      for (size_t i = from; i < from + count; ++i) {
        if (margins_[i] != given[i]) changed_[group_of_[i]] = has_changed = true;
        margins_[i] = given[i];
      }
    }
    if (!has_changed) return;
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
      const double so_far = this->so_far(g), farthest = farthest_of(g);
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
  template <class Thing>
  double gap(const Placed& at, Parting<Thing>& parting) const {
    const Thing &a = *parting.a, &b = *parting.b;
    const Pose &pose_a = at.pose(a.joint), &pose_b = at.pose(b.joint);
    if (parting.axis.x == 0.0 && parting.axis.y == 0.0 && parting.axis.z == 0.0) {
      const Vec3 apart = tmul(pose_a.R, pose_b * b.centre - pose_a * a.centre);
      const double length = norm(apart);
      if (!(length > 0.0)) return -kInfinity;
      parting.set((1.0 / length) * apart);
    }
    return gap_along(at, a, b, parting.axis, parting.reach);
  }

  // The distance of two bodies along a direction in the axes of the first one's joint, from which the
  // first one reaches so far.
  template <class Thing>
  static double gap_along(const Placed& at, const Thing& a, const Thing& b, const Vec3& axis,
                          double reach) {
    const Pose &pose_a = at.pose(a.joint), &pose_b = at.pose(b.joint);
    const Vec3 ahead = pose_a.R * axis, axis_b = tmul(pose_b.R, ahead);
    return dot(ahead, pose_b.p - pose_a.p) - reach - reach_of(b, -axis_b);
  }

  // Likewise where the robot is.
  template <class Thing>
  double gap_here(const Placed& at, Parting<Thing>& parting) const {
    if (parting.stamp != stamp_) {
      parting.gap = gap(at, parting);
      parting.stamp = stamp_;
    }
    return parting.gap;
  }

  void note(const Low<JointBox>& low) { box_lows_.push_back(low); }
  void note(const Low<Body>& low) { lows_.push_back(low); }

  // Raise keys where the last path has ended.
  template <class Thing>
  void raise(const std::vector<Low<Thing>>& lows) {
    for (const Low<Thing>& low : lows) {
      *low.key = std::max(*low.key, low.gap + so_far(low.parting->group));
      if (low.changes != low.parting->changes) continue;
      low.parting->gap = low.gap;
      low.parting->stamp = stamp_;
    }
  }

  // Raise the key of two bodies to their distance along their axis where the robot is, and return the
  // lower bound that it is then.
  template <class Thing>
  double raised(const Placed& at, Parting<Thing>& parting, double& key) const {
    const double so_far = this->so_far(parting.group);
    key = std::max(key, gap_here(at, parting) + so_far);
    return key - so_far;
  }

  // Whether two bodies are shown to stay apart by KEPT on the path to `end`, without a measurement.
  //
  // The proof in collision.py holds for any two directions at the ends, here the axis carried along.
  template <class Thing>
  bool stays_apart(const Placed& at, const Placed& end, Parting<Thing>& parting, double& key,
                   double travel) {
    const double enough = kKept + travel, so_far = this->so_far(parting.group);
    if (key - so_far > enough) return true;
    const double after = gap(end, parting);
    note({&key, &parting, parting.changes, after});
    // On a path from a to b, the distance is never below (a + b - travel) / 2.
    if (key - so_far + after >= enough) return true;
    const double before = gap_here(at, parting);
    key = std::max(key, before + so_far);
    const double low = key - so_far, nearest = std::min(before, after);
    if (low > enough || low + after >= enough) return true;
    if (before < kKept) return false;
    const int joint = parting.a->joint;
    const Vec3 axis = at.pose(joint).R * parting.axis;
    const double bend = bend_of(groups_[parting.group].begin);  // as of all its pairs
    const Vec3 change = end.pose(joint).R * parting.axis - axis;
    if (nearest - dip(change, 1.0, travel, bend) >= kKept) return true;
    // The same direction in the world may show it where the first shape turns far.
    const double there = gap_along(end, *parting.a, *parting.b, axis);
    return low + there >= enough || std::min(before, there) - dip({}, 1.0, travel, bend) >= kKept;
  }

  // How far the shapes of a pair are apart along a direction in the world.
  double gap_along(const Placed& at, size_t k, const Vec3& direction) const {
    return gap_along(at, bodies[pair(k).first], bodies[pair(k).second], direction);
  }
  template <class Thing>
  static double gap_along(const Placed& at, const Thing& a, const Thing& b, const Vec3& direction) {
    const Vec3 axis = tmul(at.pose(a.joint).R, direction);
    return gap_along(at, a, b, axis, reach_of(a, axis));
  }

  // Whether a part of a path is shown to be clear by what shapes are apart at its ends along a direction
  // that stays the same in the world.
  bool is_shown(double gap, double other, const Part& part) const {
    const double length = part.high - part.low, travel = travel_of(part.pair);
    if (gap + other - length * travel >= 2.0 * part.between) return true;
    return std::min(gap, other) - dip({}, length, travel, bend_of(part.pair)) >= part.between;
  }

  // How far below its ends a distance may be on a part of a path; see the top of this file.
  static double dip(const Vec3& change, double length, double travel, double bend) {
    return 0.125 * (2.0 * norm(change) + length * bend) * length * travel;
  }

  void know(const Placed& at, size_t k, const Found& found) {
    stamps_[k] = stamp_;
    found_[k] = found;
    partings_[k].set(tmul(at.pose(bodies[pair(k).first].joint).R, found.normal));
    keys_[k] = found.distance + so_far(partings_[k].group);
  }

  // The distance of a pair where the robot is.
  const Found& found(const Placed& at, size_t k) {
    if (stamps_[k] != stamp_) know(at, k, found_at(at, k));
    return found_[k];
  }

  // Likewise where the last path ends. Of paths that differ in one finger, most pairs end alike.
  const Found& found_at_end(const Placed& end, size_t k) {
    End& known = ends_known_[k];
    const auto [a, b] = bounds_->joints(place(k));
    if (known.path < 0 || known.path < end_changes_[a + 1] || known.path < end_changes_[b + 1]) {
      known.found = found_at(end, k);
      known.axis = tmul(end.pose(a).R, known.found.normal);
    }
    known.path = path_;
    return known.found;
  }

  // Note which joints end elsewhere than on the last path.
  void go_to_end(const Placed& end) {
    ++path_;
    for (size_t i = 0; i < end_poses_.size(); ++i) {
      const Pose& pose = end.pose(static_cast<int>(i) - 1);
      if (!std::memcmp(&pose, &end_poses_[i], sizeof(Pose))) continue;
      end_poses_[i] = pose;
      end_changes_[i] = path_;
    }
  }

  Found found_at(const Placed& at, size_t k) {
    const Body &a = bodies[pair(k).first], &b = bodies[pair(k).second];
    ++queries;
    return measure(a.shape, at.pose(a.joint) * a.placement, b.shape,
                   at.pose(b.joint) * b.placement, warm_[k], expansion_);
  }

  // See collision.CollisionLimit._meetings.
  void meet(const Placed& at, const Placed& there, size_t k, const Found& known) {
    const int a = bodies[pair(k).first].joint, b = bodies[pair(k).second].joint;
    const Pose moved_a = at.pose(a) * inverse(there.pose(a));
    const Pose moved_b = at.pose(b) * inverse(there.pose(b));
    const Vec3 normal = moved_a.R * known.normal;
    const Vec3 second = moved_b * (known.point + known.distance * known.normal);
    met_.push_back({k, {dot(normal, second - moved_a * known.point), normal, second}});
  }

  // Whether a pair may ever overlap.
  bool yields(size_t k) const { return !yielding.is_empty() && yielding.forces[place(k)] > 0.0; }

  // Find the rows of `near_` whose pairs touch, where the robot is.
  void find_touching(const Vector& G) {
    touching_.clear();
    touching_rows_.clear();
    if (yielding.is_empty()) return;
    const size_t n = tree_.size;
    for (size_t r = 0; r < near_.size(); ++r) {
      const double distance = found_[near_[r].second].distance;
      if (!(distance <= kYieldNear)) continue;
      touching_.push_back(clip(1.0 - distance / kYieldNear, 0.0, 1.0));
      touching_rows_.insert(touching_rows_.end(), G.begin() + r * n, G.begin() + (r + 1) * n);
    }
  }

  // How far a pair may overlap, by a row of its distance; see hands.ContactYield.overlaps.
  double overlap_by(const double* row, size_t place) const {
    if (yielding.is_empty() || !(yielding.forces[place] > 0.0)) return 0.0;
    const size_t n = tree_.size;
    double force = yielding.forces[place], give = 0.0;
    for (size_t i = 0; i < n; ++i) {
      if (row[i] != 0.0) force = std::min(force, yielding.torques[i] / std::abs(row[i]));
      give += row[i] * yielding.compliances[i] * row[i];
    }
    for (size_t t = 0; t < touching_.size(); ++t) {
      const double* other = touching_rows_.data() + t * n;
      double shared = 0.0;
      for (size_t i = 0; i < n; ++i) shared += row[i] * yielding.compliances[i] * other[i];
      give += touching_[t] * std::min(shared, 0.0);
    }
    return std::min(force * std::max(give, 0.0), yielding.depths[place]);
  }

  // How far a pair that was measured may overlap, where the robot is.
  double overlap(const Placed& at, size_t k) {
    if (!yields(k)) return 0.0;
    own_row_.assign(tree_.size, 0.0);
    linearise(at, k, found_[k].normal, found_[k].point, own_row_.data());
    return overlap_by(own_row_.data(), place(k));
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
        const double bend = bend_of(part.pair);
        const double nearest = std::min(part.before.distance, part.after.distance);
        const Vec3 change = part.after.normal - part.before.normal;
        if (!(nearest - dip(change, length, travel, bend) < part.between)) continue;
        const double middle = 0.5 * (part.low + part.high);
        // All parts of one interval are halved at one point.
        if (at_low != part.low) {
          if (taken == kMostPoints || has_met() || is_spent()) return false;
          ++taken;
          at_low = part.low;
          for (int c = 0; c < tree_.nv; ++c) moved_[c] = middle * step[c];
          tree_.integrate(at.q.data(), moved_.data(), reached_.data());
          middle_.place(reached_.data());
        }
        Part first = part, second = part;
        first.high = second.low = middle;
        // A half that is shown to be clear along the normal at its other end needs no measurement.
        const double ahead = gap_along(middle_, part.pair, part.before.normal);
        const double back = gap_along(middle_, part.pair, part.after.normal);
        const bool is_first_shown = is_shown(part.before.distance, ahead, first);
        const bool is_second_shown = is_shown(part.after.distance, back, second);
        if (is_first_shown && is_second_shown) continue;
        const Found between = found_at(middle_, part.pair);
        if (between.distance < part.kept) meet(at, middle_, part.pair, between);
        first.after = second.before = between;
        if (!is_first_shown) further_.push_back(first);
        if (!is_second_shown) further_.push_back(second);
      }
      if (has_met()) return false;
      // Of parts of one interval, pairs are in their order, as they were visited.
      std::sort(further_.begin(), further_.end(), [](const Part& a, const Part& b) {
        return a.low != b.low ? a.low < b.low : a.pair < b.pair;
      });
      std::swap(parts_, further_);
    }
    return true;
  }

  const Tree& tree_;
  std::int64_t most_queries_ = std::numeric_limits<std::int64_t>::max();
  Placed middle_;
  Vector q_;  // where the robot is
  long stamp_ = 0;
  std::vector<long> stamps_;   // where each pair was found last
  std::vector<Found> found_;
  Vector keys_;
  std::vector<Group> groups_;
  std::vector<Ends> group_ends_, pair_ends_;
  Vector group_keys_, group_margins_;
  const std::vector<int> none_;
  std::vector<Chain> chains_;  // of the bodies, then of the joints, that of the world first
  Vector sums_, so_far_, moved_sums_;  // of turns times levers: see `sum_along`
  Vector overlaps_;                        // that the pairs of `near_` may have
  Vector touching_, touching_rows_;        // of pairs that touch: weights and rows
  Vector own_row_;
  Vector margins_, same_;  // in the order in which pairs came
  std::vector<size_t> group_of_;  // likewise
  std::vector<char> changed_;
  std::vector<Parting<Body>> partings_;
  long path_ = 0;                  // number of the last path
  std::vector<Pose> end_poses_;    // of joints, that of the world first, where the last path ended
  std::vector<long> end_changes_;  // the path at which each of them changed last
  std::vector<End> ends_known_;    // of pairs
  std::vector<std::pair<size_t, size_t>> near_;
  std::vector<int> row_pairs_;
  std::vector<Warm> warm_;
  Expansion expansion_;
  std::vector<Low<JointBox>> box_lows_;
  std::vector<Low<Body>> lows_;
  std::vector<std::pair<size_t, Found>> ends_;
  Vector turned_, moved_, reached_;
  std::vector<Part> parts_, further_;
  std::vector<Met> met_;
};

}  // namespace handmap
