// Hostile numbers through the parts of the core that need no Python. Built with the address and the
// undefined behaviour sanitizers by test_sanitized.py; what they find ends the program.
//
// Prints the number of calls. Results are only checked where a wrong one shows in a few lines: other
// tests compare all of them with Python.
#include <cstdio>
#include <cstdlib>

#include "handmap/detours.hpp"
#include "handmap/episode.hpp"
#include "handmap/guard.hpp"
#include "handmap/posture.hpp"
#include "handmap/run.hpp"
#include "two_fingers.hpp"

using namespace handmap;

namespace {

long calls = 0;

void check(bool is_right, const char* what) {
  if (is_right) return;
  std::printf("wrong: %s\n", what);
  std::exit(1);
}

// How often numbers are hostile: never, seldom, often.
constexpr double kShares[] = {0.0, 0.02, 0.4};

void order_statistics(Numbers& numbers) {
  for (const double hostile : kShares)
    for (size_t count = 0; count < 70; ++count) {
      const Vector values = numbers.vector(count, hostile);
      const bool has_nan =
          std::any_of(values.begin(), values.end(), [](double v) { return std::isnan(v); });
      for (int k = 0; k < 4; ++k) {
        Vector copy = values;
        const double found = k == 0   ? median(copy)
                             : k == 1 ? percentile_of(copy, 95.0)
                             : k == 2 ? percentile_of(copy, 100.0)
                                      : upper_median(copy.data(), count);
        ++calls;
        check(!(k < 3 && (has_nan || count == 0)) || std::isnan(found), "a number made of NaN");
        check(!(k == 2 && count > 0 && !has_nan) ||
                  found == *std::max_element(values.begin(), values.end()) || std::isnan(found),
              "the largest value");
      }
      Vector changes = values;
      noise_of(changes.data(), static_cast<int>(count), 1.0);
    }
}

void rotations(Numbers& numbers) {
  for (int round = 0; round < 2000; ++round) {
    Mat3 a;
    for (double& each : a.m) each = numbers.number(kShares[round % 3]);
    nearest_rotation(a);
    svd3(a);
    log3(a);
    exp3(numbers.point(kShares[round % 3]));
    quat_of(a);
    log6({a, numbers.point(kShares[round % 3])});
    jlog6({a, numbers.point(kShares[round % 3])});
    ++calls;
  }
}

void problems(Numbers& numbers) {
  GuessedQp guessed;
  Qp qp;
  for (int round = 0; round < 3000; ++round) {
    const double hostile = kShares[round % 3];
    const int n = 1 + numbers.below(12), rows = numbers.below(8);
    const Vector root = numbers.vector(n * n, hostile);
    Vector H(n * n, 0.0);
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) {
        for (int k = 0; k < n; ++k) H[i * n + j] += root[k * n + i] * root[k * n + j];
        if (i == j) H[i * n + j] += 1e-6;
      }
    const Vector c = numbers.vector(n, hostile), G = numbers.vector(rows * n, hostile),
                 h = numbers.vector(rows, hostile);
    Vector lower = numbers.vector(n, hostile), upper = lower;
    for (double& each : upper) each += std::abs(numbers.number(hostile));
    std::vector<signed char> guess(n);
    for (signed char& each : guess) each = static_cast<signed char>(numbers.below(3) - 1);
    qp.solve(n, H.data(), c.data(), lower.data(), upper.data(), rows, G.data(), h.data());
    guessed.solve(n, H.data(), c.data(), lower.data(), upper.data(), rows, G.data(), h.data(), guess);
    Rows linear{rows, G, h};
    Feasible feasible;
    Vector loosened;
    feasible.loosen(linear, lower, upper, 0.5, Vector(n, 0.0), loosened);
    ++calls;
  }
}

// Of hulls that models have, seldom of many points, and of flat ones.
std::vector<Vec3> hull_points(Numbers& numbers) {
  const bool is_large = numbers.below(16) == 0;
  std::vector<Vec3> found = numbers.points(1 + numbers.below(is_large ? 40 : 16), 0.0, 0.05);
  const bool is_flat = numbers.below(4) == 0, is_same = numbers.below(8) == 0;
  for (Vec3& each : found) {
    if (is_large) continue;
    if (is_flat) each.z = 0.0;
    if (is_same) each = found[0];
  }
  return found;
}

Shape shape(Numbers& numbers, double hostile) {
  const auto size = [&] { return std::abs(numbers.number(hostile, 0.05)); };
  switch (numbers.below(4)) {
    case 0: return make_box({size(), size(), size()});
    case 1: return make_sphere(size());
    case 2: return make_capsule(size(), size());
  }
  return make_convex(hull_points(numbers));
}

void shapes(Numbers& numbers) {
  for (int round = 0; round < 60; ++round) {
    const double hostile = kShares[round % 3];
    const Hull hull(hull_points(numbers));
    for (int i = 0; i < 50; ++i) hull.vertex(hull.farthest(numbers.point(hostile)));
    const Shape a = shape(numbers, hostile), b = shape(numbers, hostile);
    Warm warm{};
    for (int i = 0; i < 5; ++i) {
      measure(a, numbers.pose(hostile), b, numbers.pose(hostile), warm);
      ++calls;
    }
  }
}

std::vector<Vec3> hands(Numbers& numbers, size_t count, double hostile) {
  std::vector<Vec3> found;
  for (size_t t = 0; t < count; ++t)
    for (int i = 0; i < kLandmarks; ++i) {
      const Vec3 at{0.02 * ((i + 3) / 4), 0.02 * (i ? 1 + (i - 1) % 4 : 0), 0.001 * (i % 3)};
      found.push_back(at + numbers.point(hostile, 1e-3));
    }
  return found;
}

void persons(Numbers& numbers) {
  const PersonMeter meter{};
  for (int round = 0; round < 300; ++round) {
    const double hostile = kShares[round % 3];
    const size_t count = 1 + numbers.below(60);
    const std::vector<Vec3> landmarks = hands(numbers, count, hostile);
    meter.measure(landmarks, numbers.points(5, hostile, 0.05));
    Vector time(count), wrong = numbers.vector(count, hostile);
    for (size_t t = 0; t < count; ++t) time[t] = 0.02 * t;
    smallest_gap(time.data(), landmarks, 0.1, 1.0);
    smallest_gap(wrong.data(), landmarks, 0.1, 1.0);
    // Columns of an episode.
    const std::unique_ptr<bool[]> flags(new bool[4 * count]);
    for (size_t i = 0; i < 4 * count; ++i) flags[i] = numbers.below(3) > 0;
    flags[0] = true;
    const Vector errors = numbers.vector(3 * count, hostile), q = numbers.vector(2 * count, hostile);
    const EpisodeMeter episode{count, wrong.data(), &landmarks[0].x, flags.get(), flags.get(),
                               errors.data(), 3, {flags.get(), 2}, {flags.get(), 2}, q.data(), 2};
    Vector reaches = episode.reaches();
    EpisodeMeter::mean_of(reaches);
    percentile_of(reaches, 95.0);
    episode.longest_gap();
    episode.bone_variation();
    episode.share(episode.at_limit, false);
    episode.jerk();
    ++calls;
  }
}

void smoothing(Numbers& numbers) {
  for (int round = 0; round < 300; ++round) {
    const double hostile = kShares[round % 3];
    Smoother smoother;
    smoother.options = Smoothing{0.4, 12.0};
    for (int i = 0; i < 12; ++i) {
      // The number of points may change.
      const size_t count = numbers.below(3) ? 21 : numbers.below(4);
      HumanPose pose{numbers.points(count, hostile, 0.1), numbers.below(4) > 0, numbers.pose(hostile)};
      smoother.smooth(pose, std::abs(numbers.number(hostile, 0.02)));
      if (numbers.below(5) == 0) smoother.forget();
      if (numbers.below(9) == 0) smoother.restart();
      ++calls;
    }
  }
}

// Landmarks of a hand at rest, a right one for a sign of 1, so many times as large.
Landmarks resting(double sign, double size) {
  Landmarks found{};
  for (int finger = 0; finger < 5; ++finger) {
    const bool is_thumb = finger == 0;
    Vec3 at{sign * size * (is_thumb ? -0.03 : 0.02 * finger - 0.05), size * (is_thumb ? 0.03 : 0.09), 0.0};
    const Vec3 step{is_thumb ? -sign * 0.6 : 0.0, 0.8, -0.3};
    for (int k = 0; k < 4; ++k) {
      found[1 + 4 * finger + k] = at;
      at += (size * (0.04 - 0.006 * k)) * step;
    }
  }
  return found;
}

using Order = std::array<int, kLandmarks>;

Order shuffled(Numbers& numbers) {
  Order order;
  for (int k = 0; k < kLandmarks; ++k) order[k] = k;
  for (int k = kLandmarks - 1; k > 0; --k) std::swap(order[k], order[numbers.below(k + 1)]);
  return order;
}

// Our own order, those of all fingers if wanted, and others at random.
std::shared_ptr<const LandmarkOrders> orders_of(Numbers& numbers, bool has_fingers) {
  std::vector<Order> orders(1);
  for (int k = 0; k < kLandmarks; ++k) orders[0][k] = k;
  std::array<int, 5> fingers{0, 1, 2, 3, 4};
  while (has_fingers && std::next_permutation(fingers.begin(), fingers.end())) {
    Order& order = orders.emplace_back();
    order[0] = 0;
    for (int k = 1; k < kLandmarks; ++k) order[k] = 1 + 4 * fingers[(k - 1) / 4] + (k - 1) % 4;
  }
  for (int more = numbers.below(4); more > 0; --more) orders.push_back(shuffled(numbers));
  return std::make_shared<const LandmarkOrders>(std::move(orders));
}

// What is wrong with the samples of a hand for a while.
enum class Fault { none, mirrored, size, order, one_away, one_place, stuck, hostile, count };

void spoil(Numbers& numbers, Fault fault, const Order& order, Landmarks& hand) {
  const Landmarks right = hand;
  switch (fault) {
    case Fault::mirrored:
      for (Vec3& each : hand) each.x = -each.x;
      break;
    case Fault::size:
      for (Vec3& each : hand) each *= 1000.0;
      break;
    case Fault::order:
      for (int k = 0; k < kLandmarks; ++k) hand[k] = right[order[k]];
      break;
    case Fault::one_away:
      hand[numbers.below(kLandmarks)] += numbers.point(0.0, 0.1);
      break;
    case Fault::one_place:
      hand.fill(right[0]);
      break;
    case Fault::hostile:
      for (Vec3& each : hand) each += numbers.point(0.4, 1e-3);
      break;
    default:
      break;
  }
}

// Whether what a guard says of a sample goes with what it said before.
void check_verdict(const Verdict& verdict, double before) {
  check(!(verdict.is_held && verdict.is_return), "a return that is held");
  check(verdict.time >= before, "a time that goes back");
  check(verdict.dt >= 0.0 && std::isfinite(verdict.dt), "a time between samples");
  check(kNothing <= verdict.rule && verdict.rule <= kUnproven, "a rule");
  check(verdict.finding.is_sound(), "a finding");
}

// A hand that moves for seconds, with faults for a while; returns how many samples were followed.
int judge_stream(Numbers& numbers, double hostile, const LandmarkOrders& known,
                 StreamGuard guard, const Landmarks& at_rest) {
  const Pose start = numbers.pose(0.0);
  const Vec3 speed = numbers.point(0.0, 0.1), turn = numbers.point(0.0, 0.3);
  const bool has_wrist = numbers.below(2) > 0, arrives = numbers.below(2) > 0;
  const Order order = known.orders[numbers.below(static_cast<int>(known.orders.size()))];
  Landmarks last{};
  double stamp = 0.0, time = 0.0, before = 0.0;
  Fault fault = Fault::none;
  bool has_times = true;
  int followed = 0;
  for (int i = 0; i < 160; ++i) {
    if (hostile > 0.0 && i % 20 == 19)
      fault = static_cast<Fault>(numbers.below(static_cast<int>(Fault::count)));
    time += 0.02;
    stamp += hostile > 0.0 && numbers.below(12) == 0 ? numbers.number(hostile, 0.2) : 0.02;
    const Pose wrist{exp3(time * turn) * start.R, start.p + time * speed};
    Landmarks hand;
    for (int k = 0; k < kLandmarks; ++k) hand[k] = wrist * at_rest[k] + numbers.point(0.0, 2e-4);
    spoil(numbers, fault, order, hand);
    if (fault == Fault::stuck) hand = last;
    last = hand;
    double pose[16] = {wrist.R(0, 0), wrist.R(0, 1), wrist.R(0, 2), wrist.p.x,
                       wrist.R(1, 0), wrist.R(1, 1), wrist.R(1, 2), wrist.p.y,
                       wrist.R(2, 0), wrist.R(2, 1), wrist.R(2, 2), wrist.p.z,
                       0.0,           0.0,           0.0,           1.0};
    if (fault == Fault::hostile) pose[numbers.below(16)] = numbers.number(hostile);
    const bool is_seen = hostile == 0.0 || numbers.below(30) > 0;
    const StreamSample sample{stamp, &hand[0].x, has_wrist ? pose : nullptr, is_seen, 1.0,
                              arrives ? time : kNaN};
    StreamGuard copy = guard;
    const Verdict verdict = guard.check(sample), again = copy.check(sample);
    check(verdict.rule == again.rule && verdict.is_held == again.is_held, "a copy");
    // Python lets no other stamps in, behind which no time is known.
    has_times &= std::isfinite(stamp);
    if (has_times) check_verdict(verdict, before);
    if (!std::isfinite(stamp)) stamp = time;
    before = verdict.time;
    followed += !verdict.is_held;
    ++calls;
  }
  guard.input.finish();
  return followed;
}

void guards(Numbers& numbers) {
  for (int round = 0; round < 48; ++round) {
    const double hostile = kShares[round % 3], sign = round % 2 ? 1.0 : -1.0;
    const auto known = orders_of(numbers, round % 12 < 6);
    const Landmarks person = resting(sign, 0.8 + 0.1 * numbers.below(5));
    const StreamGuard guard(sign, person, known);
    const int followed = judge_stream(numbers, hostile, *known, guard, person);
    check(hostile > 0.0 || followed > 100, "a hand that moves as it should is followed");
  }
}

void solvers(Numbers& numbers) {
  for (int round = 0; round < 60; ++round) {
    const double hostile = kShares[round % 3];
    Ik ik(fingers(round % 2 == 0));
    const int n = ik.tree.size;
    ik.weights = {{100.0, 100.0}, 100.0, 10.0, 1e-3, 0.5};
    ik.settings = {8, 1e-4, 1e-4, 0.01, 0.0, 0.0, round % 5 == 0};
    ik.limits = box_limits_of(ik.tree);
    ik.limits.together.assign(n, static_cast<char>(round % 4 == 0));
    if (round % 3) ik.limits.acceleration = 40.0;
    if (round % 4 < 2) {
      ik.pairs = std::make_unique<Pairs>(ik.tree, boxes_of(ik.tree));
      ik.pairs->margin = 1e-3;
    }
    ik.takes_detours = round % 6 == 0;
    ik.stop_detours();
    ik.motion = {ik.tree.rest, Vector(n, 0.0), 1.0 / 60.0, Vector(n, 0.0)};
    const Motion start = ik.motion;
    Result result;
    for (int i = 0; i < 30; ++i) {
      Goal goal;
      goal.points = numbers.points(2, hostile, 0.1);
      if (numbers.below(2)) goal.wrists = {numbers.pose(hostile)};
      goal.postures.clear();
      goal.pull(0.01, numbers.vector(4, hostile), {});
      const When when = When::after(std::abs(numbers.number(hostile, 0.02)));
      seek(ik, goal, when, {}, numbers.number(hostile) > 0.0 ? 1.0 : 0.2, result);
      if (numbers.below(5) == 0) ik.hold(when, result);
      if (numbers.below(5) == 0) {
        Vector goal_q = ik.tree.rest;
        for (double& q : goal_q) q += numbers.number(hostile, 0.3);
        ik.advance(goal_q, when, 0.5, numbers.below(2));
      }
      if (numbers.below(5) == 0) {
        const Vector wanted = numbers.vector(n, hostile);
        ik.admit(wanted, wanted, ik.motion.next(when));
      }
      // Where hostile numbers have led, nobody goes on.
      bool is_finite = true;
      for (const double q : ik.motion.q) is_finite &= std::isfinite(q);
      check(is_finite || hostile > 0.0, "a configuration");
      if (!is_finite) ik.motion = start;
      ++calls;
    }
  }
}

void postures(Numbers& numbers) {
  const Tree tree = fingers(true);
  for (int round = 0; round < 200; ++round) {
    const double hostile = kShares[round % 3];
    NearestPosture problem(tree);
    problem.targets = numbers.points(2, hostile, 0.1);
    problem.costs = {1.0, 1.0};
    problem.rest_cost = 1e-3;
    problem.solve(numbers.vector(4, hostile));
    const std::shared_ptr<PairBounds> bounds = boxes_of(tree);
    SmallestDistances distances(*bounds);
    Placed placed(tree);
    Vector q = numbers.vector(tree.nq, hostile);
    placed.place(q.data());
    distances.measure(placed, 0.5);
    ++calls;
  }
}

}  // namespace

int main(int count, char** arguments) {
  Numbers numbers(count > 1 ? static_cast<unsigned>(std::atoi(arguments[1])) : 1u);
  order_statistics(numbers);
  rotations(numbers);
  problems(numbers);
  shapes(numbers);
  persons(numbers);
  smoothing(numbers);
  guards(numbers);
  solvers(numbers);
  postures(numbers);
  std::printf("%ld calls\n", calls);
}
