// Properties of the parts of the core, without Python: kinematics against finite differences, distances
// against what rigid motion and convexity demand, the QP against its optimality conditions, and the gate
// against a judge that sees nothing but configurations and time stamps.
//
// Prints the number of properties that were checked; the first one that fails ends the program.
#include <cstdio>
#include <cstdlib>

#include "handmap/gate.hpp"
#include "two_fingers.hpp"

using namespace handmap;

namespace {

long checked = 0;

void check(bool is_right, const char* what, double off = 0.0) {
  ++checked;
  if (is_right) return;
  std::printf("wrong: %s (%g)\n", what, off);
  std::exit(1);
}

void check_small(double off, double most, const char* what) { check(std::abs(off) <= most, what, off); }

Vec3 unit(Numbers& numbers) {
  const Vec3 d = numbers.point(0.0);
  return (1.0 / norm(d)) * d;
}

// -- kinematics

// Six joints with random axes and places, on a wrist that may float. The last one follows the one before.
Tree random_tree(Numbers& numbers, bool is_floating) {
  Tree tree;
  if (is_floating) {
    tree.joints.push_back({-1, JointKind::floating, {}, numbers.pose(0.0), 0, 0});
    tree.nq = 7;
    tree.nv = 6;
  }
  const int first = static_cast<int>(tree.joints.size());
  for (int k = 0; k < 6; ++k) {
    const int last = static_cast<int>(tree.joints.size()) - 1;
    const int parent = k == 3 ? first - 1 : last;
    const JointKind kind = numbers.below(3) ? JointKind::revolute : JointKind::prismatic;
    tree.joints.push_back({parent, kind, unit(numbers), numbers.pose(0.0), tree.nq++, tree.nv++});
  }
  tree.size = tree.nv - 1;
  for (int c = 0; c < tree.nv; ++c) {
    tree.leader.push_back(std::min(c, tree.size - 1));
    tree.factor.push_back(c < tree.size ? 1.0 : -0.7);
  }
  tree.rest.assign(tree.nq, 0.0);
  if (is_floating) tree.rest[6] = 1.0;
  tree.finish();
  return tree;
}

Vector random_configuration(Numbers& numbers, const Tree& tree) {
  const Vector step = numbers.vector(tree.nv, 0.0, 0.8);
  Vector q(tree.nq);
  tree.integrate(tree.rest.data(), step.data(), q.data());
  return q;
}

void velocities_are_derivatives(Numbers& numbers) {
  for (int round = 0; round < 40; ++round) {
    const Tree tree = random_tree(numbers, round % 2);
    const Vector q = random_configuration(numbers, tree);
    const int last = static_cast<int>(tree.joints.size()) - 1;
    const Attached tip{last, numbers.point(0.0, 0.1)};
    Placed here(tree), there(tree);
    here.place(q.data());
    const double h = 1e-6;
    for (int c = 0; c < tree.nv; ++c) {
      Vec3 ends[2];
      for (const int side : {0, 1}) {
        Vector step(tree.nv, 0.0), moved(tree.nq);
        step[c] = side ? h : -h;
        tree.integrate(q.data(), step.data(), moved.data());
        there.place(moved.data());
        ends[side] = there.point(tip);
      }
      const bool moves_it = std::count(tree.supports[last].begin(), tree.supports[last].end(), c);
      const Vec3 expected = moves_it ? here.velocity(c, here.point(tip)) : Vec3{};
      check_small(norm((0.5 / h) * (ends[1] - ends[0]) - expected), 1e-7, "velocity of a point");
    }
  }
}

void motion_goes_back(Numbers& numbers) {
  for (int round = 0; round < 200; ++round) {
    const Tree tree = random_tree(numbers, round % 2);
    const Vector q = random_configuration(numbers, tree);
    Vector step = numbers.vector(tree.nv, 0.0), there(tree.nq), back(tree.nq);
    tree.integrate(q.data(), step.data(), there.data());
    for (double& each : step) each = -each;
    tree.integrate(there.data(), step.data(), back.data());
    for (int i = 0; i < tree.nq; ++i) check_small(back[i] - q[i], 1e-12, "a twist and its inverse");
  }
}

void links_are_rigid(Numbers& numbers) {
  for (int round = 0; round < 100; ++round) {
    const Tree tree = random_tree(numbers, round % 2);
    const int joint = numbers.below(static_cast<int>(tree.joints.size()));
    const Vec3 a = numbers.point(0.0), b = numbers.point(0.0);
    Placed at(tree);
    const Vector q = random_configuration(numbers, tree);
    at.place(q.data());
    const double length = norm(at.point({joint, a}) - at.point({joint, b}));
    check_small(length - norm(a - b), 1e-12, "two points of a link");
    check_small(determinant(at.pose(joint).R) - 1.0, 1e-12, "a rotation");
  }
}

void followers_follow(Numbers& numbers) {
  for (int round = 0; round < 50; ++round) {
    const Tree tree = random_tree(numbers, round % 2);
    const Vector active = numbers.vector(tree.size, 0.0);
    Vector all(tree.nv);
    tree.expand(active.data(), all.data());
    check_small(all[tree.nv - 1] + 0.7 * active[tree.size - 1], 1e-15, "a joint that follows");
  }
}

// -- distances

Shape random_shape(Numbers& numbers, int kind) {
  const auto size = [&] { return 0.005 + 0.02 * std::abs(numbers.plain()); };
  if (kind == 0) return make_box({size(), size(), size()});
  if (kind == 1) return make_sphere(size());
  if (kind == 2) return make_capsule(size(), size());
  return make_convex(numbers.points(24, 0.0, 0.02));
}

Found distance_of(const Shape& a, const Pose& at_a, const Shape& b, const Pose& at_b) {
  Warm warm{};
  return measure(a, at_a, b, at_b, warm);
}

Pose moved(const Pose& pose, const Vec3& by) { return {pose.R, pose.p + by}; }

void distances_have_closed_forms(Numbers& numbers) {
  for (int round = 0; round < 100; ++round) {
    const double r = 0.01 + 0.01 * std::abs(numbers.plain()), s = 0.02;
    const Pose a = numbers.pose(0.0), b = numbers.pose(0.0);
    const double spheres = distance_of(make_sphere(r), a, make_sphere(s), b).distance;
    check_small(spheres - (norm(a.p - b.p) - r - s), 1e-12, "two spheres");
    // Boxes with the same axes, one above the other.
    const double gap = 0.05 * numbers.plain() + 0.02;
    const Pose above{a.R, a * Vec3{0.002, -0.003, 0.03 + gap}};
    const double boxes =
        distance_of(make_box({0.02, 0.02, 0.01}), a, make_box({0.01, 0.03, 0.02}), above).distance;
    if (gap > -0.01) check_small(boxes - gap, 1e-10, "two boxes");
  }
}

void distances_are_of_convex_shapes(Numbers& numbers) {
  for (int round = 0; round < 800; ++round) {
    const Shape a = random_shape(numbers, round % 4), b = random_shape(numbers, round / 4 % 4);
    const Pose at_a = numbers.pose(0.0, 0.03), at_b = numbers.pose(0.0, 0.03), by = numbers.pose(0.0);
    const Found found = distance_of(a, at_a, b, at_b);
    const Found other = distance_of(b, at_b, a, at_a);
    check_small(other.distance - found.distance, 1e-9, "which shape comes first");
    const Found carried = distance_of(a, by * at_a, b, by * at_b);
    check_small(carried.distance - found.distance, 1e-9, "a rigid motion of both");
    check_small(norm(found.normal) - 1.0, 1e-9, "the length of a normal");
    // A plane across the normal parts two convex shapes, so that this is exact, from an overlap too.
    const double way = 0.03 + std::max(0.0, -found.distance);
    const Found apart = distance_of(a, at_a, b, moved(at_b, way * found.normal));
    check_small(apart.distance - (found.distance + way), 1e-8, "a motion along the normal");
    // No other translation changes the distance by more than its length.
    const Vec3 step = numbers.point(0.0, 0.01);
    const Found near = distance_of(a, at_a, b, moved(at_b, step));
    check(std::abs(near.distance - found.distance) <= norm(step) + 1e-9, "a translation");
    // What the last measurement left does not decide the result.
    Warm warm{};
    measure(a, at_a, b, moved(at_b, step), warm);
    const Found again = measure(a, at_a, b, at_b, warm);
    check_small(again.distance - found.distance, 1e-9, "where a search starts");
  }
}

// -- the QP

struct Problem {
  int n, rows;
  Vector H, c, lower, upper, G, h, inside;  // `inside` satisfies all constraints

  double cost_slope(const Vector& x, int i) const {
    double slope = c[i];
    for (int j = 0; j < n; ++j) slope += H[i * n + j] * x[j];
    return slope;
  }
  double row(int r, const Vector& x) const {
    double sum = 0.0;
    for (int i = 0; i < n; ++i) sum += G[r * n + i] * x[i];
    return sum;
  }
};

Problem random_problem(Numbers& numbers) {
  const int n = 2 + numbers.below(10), rows = numbers.below(6);
  Problem p{n, rows, Vector(n * n, 0.0), numbers.vector(n, 0.0, 5.0), {}, {},
            numbers.vector(rows * n, 0.0), {}, numbers.vector(n, 0.0, 0.3)};
  const Vector root = numbers.vector(n * n, 0.0);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j) {
      for (int k = 0; k < n; ++k) p.H[i * n + j] += root[k * n + i] * root[k * n + j];
      if (i == j) p.H[i * n + j] += 0.1;
    }
  for (int i = 0; i < n; ++i) {
    p.lower.push_back(p.inside[i] - std::abs(numbers.plain()));
    p.upper.push_back(p.inside[i] + std::abs(numbers.plain()));
  }
  for (int r = 0; r < rows; ++r) p.h.push_back(p.row(r, p.inside) + 0.3 * std::abs(numbers.plain()));
  return p;
}

// Solve A x = b by elimination with pivots; A is (n, n) and goes.
Vector solved(Vector A, Vector b) {
  const size_t n = b.size();
  for (size_t k = 0; k < n; ++k) {
    size_t pivot = k;
    for (size_t i = k; i < n; ++i)
      if (std::abs(A[i * n + k]) > std::abs(A[pivot * n + k])) pivot = i;
    for (size_t j = 0; j < n; ++j) std::swap(A[k * n + j], A[pivot * n + j]);
    std::swap(b[k], b[pivot]);
    for (size_t i = k + 1; i < n; ++i) {
      const double share = A[i * n + k] / A[k * n + k];
      for (size_t j = k; j < n; ++j) A[i * n + j] -= share * A[k * n + j];
      b[i] -= share * b[k];
    }
  }
  for (size_t k = n; k-- > 0;) {
    for (size_t j = k + 1; j < n; ++j) b[k] -= A[k * n + j] * b[j];
    b[k] /= A[k * n + k];
  }
  return b;
}

// The slope of the cost is a sum of the active constraints' normals, with multipliers >= 0.
void check_optimal(const Problem& p, const Vector& x) {
  std::vector<Vector> normals;
  for (int i = 0; i < p.n; ++i) {
    check(x[i] >= p.lower[i] - 1e-9 && x[i] <= p.upper[i] + 1e-9, "a bound", x[i]);
    Vector normal(p.n, 0.0);
    normal[i] = x[i] <= p.lower[i] + 1e-9 ? -1.0 : 1.0;
    if (x[i] <= p.lower[i] + 1e-9 || x[i] >= p.upper[i] - 1e-9) normals.push_back(normal);
  }
  for (int r = 0; r < p.rows; ++r) {
    const double value = p.row(r, x);
    check(value <= p.h[r] + 1e-9, "a row", value - p.h[r]);
    if (value >= p.h[r] - 1e-9)
      normals.emplace_back(p.G.begin() + r * p.n, p.G.begin() + (r + 1) * p.n);
  }
  const size_t m = normals.size();
  check(m <= static_cast<size_t>(p.n), "more active constraints than coordinates");
  Vector gram(m * m, 0.0), right(m, 0.0), left(p.n);
  for (int i = 0; i < p.n; ++i) left[i] = -p.cost_slope(x, i);
  for (size_t a = 0; a < m; ++a)
    for (int i = 0; i < p.n; ++i) {
      right[a] += normals[a][i] * left[i];
      for (size_t b = 0; b < m; ++b) gram[a * m + b] += normals[a][i] * normals[b][i];
    }
  const Vector multipliers = solved(gram, right);
  for (size_t a = 0; a < m; ++a) {
    check(multipliers[a] >= -1e-7, "a multiplier", multipliers[a]);
    for (int i = 0; i < p.n; ++i) left[i] -= multipliers[a] * normals[a][i];
  }
  for (const double each : left) check_small(each, 1e-7, "the slope of the cost");
}

void solutions_are_optimal(Numbers& numbers) {
  Qp qp;
  for (int round = 0; round < 2000; ++round) {
    const Problem p = random_problem(numbers);
    check(qp.solve(p.n, p.H.data(), p.c.data(), p.lower.data(), p.upper.data(), p.rows, p.G.data(),
                   p.h.data()),
          "a feasible problem");
    check_optimal(p, qp.x);
  }
}

void contradictions_are_found(Numbers& numbers) {
  Qp qp;
  for (int round = 0; round < 200; ++round) {
    Problem p = random_problem(numbers);
    // No point of the box has a sum below that of its lower corner.
    double least = 0.0;
    for (const double each : p.lower) least += each;
    p.G.insert(p.G.end(), p.n, 1.0);
    p.h.push_back(least - 0.1);
    const bool is_solved = qp.solve(p.n, p.H.data(), p.c.data(), p.lower.data(), p.upper.data(),
                                    p.rows + 1, p.G.data(), p.h.data());
    check(!is_solved, "a problem without a solution");
  }
}

// -- the gate

constexpr double kTipRadius = 0.008;
const Vec3 kTip{0.0, 0.03, 0.0};

// Distance of both fingertips' surfaces at joint positions, without the core's kinematics.
double tip_gap(const double* q) {
  const auto tip = [q](int finger) {
    const double a = q[2 * finger], b = a + q[2 * finger + 1];
    return Vec3{0.03 * finger - 0.04 * std::sin(a) - 0.03 * std::sin(b),
                0.05 + 0.04 * std::cos(a) + 0.03 * std::cos(b), 0.0};
  };
  return norm(tip(0) - tip(1)) - 2.0 * kTipRadius;
}

// Judges a stream of commands by their configurations and time stamps.
class Judge {
 public:
  Judge(const Gate& gate) : limits_(gate.limits), q_(gate.motion.q), time_(gate.motion.time) {}

  void take(const Gate& gate) {
    const Vector& q = gate.motion.q;
    const double dt = gate.motion.time - time_;
    check(dt > 0.99 * kShortestDt, "a command that is later than the last", dt);
    Vector velocity(q.size());
    for (size_t i = 0; i < q.size(); ++i) {
      check(q[i] >= limits_.lower[i] && q[i] <= limits_.upper[i], "a position limit", q[i]);
      velocity[i] = (q[i] - q_[i]) / dt;
      // Rounding of positions and of time stamps.
      const double rounding = 1e-9 + 1e-15 / dt;
      check(std::abs(velocity[i]) <= limits_.speeds[i] * (1.0 + 1e-9) + rounding, "a speed limit",
            velocity[i]);
      const double change = std::abs(velocity[i] - velocity_[i]);
      check(change <= limits_.acceleration * dt * (1.0 + 1e-6) + 2.0 * rounding + last_rounding_,
            "an acceleration limit", change / dt);
      largest_ = std::max(largest_, std::abs(velocity[i]));
    }
    for (int k = 0; k <= 20; ++k) {
      Vector between(q.size());
      for (size_t i = 0; i < q.size(); ++i) between[i] = q_[i] + 0.05 * k * (q[i] - q_[i]);
      const double gap = tip_gap(between.data());
      check(gap >= 0.0 || !gate.pairs, "an overlap", gap);
      nearest_ = std::min(nearest_, gap);
    }
    q_ = q;
    velocity_ = velocity;
    time_ = gate.motion.time;
    last_rounding_ = 1e-9 + 1e-15 / dt;
  }
  double nearest() const { return nearest_; }
  double largest() const { return largest_; }

 private:
  const BoxLimits& limits_;
  Vector q_, velocity_ = Vector(4, 0.0);
  double time_, last_rounding_ = 0.0, nearest_ = kInfinity, largest_ = 0.0;
};

// Of two fingers whose tips are kept apart, so that all joints brake together; or of joints that brake by
// themselves.
std::unique_ptr<Gate> gate_of(double acceleration, bool is_apart = true) {
  auto gate = std::make_unique<Gate>(fingers(false, {0, 0, 1}));
  gate->limits = box_limits_of(gate->tree);
  gate->limits.acceleration = acceleration;
  gate->limits.together.assign(gate->tree.size, is_apart);
  if (is_apart)
    gate->pairs = std::make_unique<Pairs>(
        gate->tree, pair_of(gate->tree, make_sphere(kTipRadius), kTip, kTipRadius));
  gate->set_motion({gate->tree.rest, Vector(4, 0.0), 1.0, Vector(4, 0.0), 0.0, new_stamp(), 0});
  return gate;
}

// The instant of the next command: usually 20 ms later, now and then the same, earlier, or after a gap.
When next_instant(Numbers& numbers, double& clock) {
  const int kind = numbers.below(12);
  if (kind == 0) return When::at(clock, 0.05);
  if (kind == 1) return When::at(clock - 0.01, 0.05);
  clock += kind == 2 ? 0.4 : 0.01 + 0.02 * std::abs(numbers.plain());
  return When::at(clock, 0.05);
}

void limits_hold_by_time_stamps(Numbers& numbers) {
  double nearest = kInfinity, largest = 0.0;
  for (int round = 0; round < 60; ++round) {
    const double acceleration = round % 3 ? 20.0 * (round % 3) : kInfinity;
    const std::unique_ptr<Gate> gate = gate_of(acceleration, round % 2);
    Judge judge(*gate);
    double clock = 0.0;
    Vector goal = numbers.vector(4, 0.0);
    for (int i = 0; i < 150; ++i) {
      if (numbers.below(12) == 0) goal = numbers.vector(4, 0.0);
      const When when = next_instant(numbers, clock);
      const int kind = numbers.below(8);
      if (kind == 0) {
        gate->brake(when);
      } else if (kind < 4) {
        gate->advance(goal, when, 1.0, kind == 1);
      } else {
        const Vector wanted = numbers.vector(4, 0.0, 0.2);
        gate->admit(wanted, wanted, gate->motion.next(when));
      }
      judge.take(*gate);
    }
    if (gate->pairs) nearest = std::min(nearest, judge.nearest());
    largest = std::max(largest, judge.largest());
  }
  // A judge of fingers that never meet, or stand still, would see nothing.
  check(nearest < 1e-3, "fingertips that meet", nearest);
  check(largest > 2.9, "a speed near its limit", largest);
}

void stops_are_possible(Numbers& numbers) {
  for (int round = 0; round < 200; ++round) {
    const std::unique_ptr<Gate> gate = gate_of(10.0 + 40.0 * std::abs(numbers.plain()));
    for (int i = 0; i < 30; ++i) {
      const Vector wanted = numbers.vector(4, 0.0, 0.2);
      gate->admit(wanted, wanted, gate->motion.next(When::after(0.02)));
    }
    double elapsed = 0.0;
    while (gate->motion.stop_times != Vector(4, 0.0)) {
      const double dt = 0.005 + 0.02 * std::abs(numbers.plain());
      gate->brake(When::after(dt));
      elapsed += dt;
      check(elapsed < kLongestStop + 0.2, "a stop that ends", elapsed);
      check(tip_gap(gate->motion.q.data()) >= 0.0, "an overlap of a stop");
    }
    gate->brake(When::after(0.02));
    for (const double each : gate->motion.displacement) check_small(each, 0.0, "a robot that stands");
  }
}

void goals_are_reached(Numbers& numbers) {
  for (int round = 0; round < 100; ++round) {
    const std::unique_ptr<Gate> gate = gate_of(round % 2 ? 30.0 : kInfinity);
    // Both fingers outwards, where nothing is in the way.
    const double a = std::abs(numbers.plain(0.3)), b = std::abs(numbers.plain(0.3));
    const Vector goal{std::min(a, 0.7), 0.1, -std::min(b, 0.7), -0.1};
    bool is_there = false;
    for (int i = 0; i < 200 && !is_there; ++i)
      is_there = gate->advance(goal, When::after(0.02), 0.5, true);
    check(is_there && gate->motion.q == goal, "a goal that is free");
  }
}

void wrong_goals_do_not_move() {
  const std::unique_ptr<Gate> gate = gate_of(30.0);
  const Vector before = gate->motion.q;
  check(!gate->advance({0.1, NAN, 0.0, 0.0}, When::after(0.02), 1.0, false), "a goal of NaN");
  check(gate->motion.q == before, "a robot without a goal");
  gate->admit(Vector(4, NAN), Vector(4, NAN), gate->motion.next(When::after(0.02)));
  for (const double q : gate->motion.q) check(std::isfinite(q), "a displacement of NaN");
}

}  // namespace

int main(int count, char** arguments) {
  Numbers numbers(count > 1 ? static_cast<unsigned>(std::atoi(arguments[1])) : 1u);
  velocities_are_derivatives(numbers);
  motion_goes_back(numbers);
  links_are_rigid(numbers);
  followers_follow(numbers);
  distances_have_closed_forms(numbers);
  distances_are_of_convex_shapes(numbers);
  solutions_are_optimal(numbers);
  contradictions_are_found(numbers);
  limits_hold_by_time_stamps(numbers);
  stops_are_possible(numbers);
  goals_are_reached(numbers);
  wrong_goals_do_not_move();
  std::printf("%ld properties\n", checked);
}
