// Tells wrong input from a human hand, batch by batch: see handmap_qp/trackers (plausibility.py,
// hand_geometry.py, wrist_axes.py), whose names these are.
//
// The core proves that a batch is a hand. Where it cannot, Python examines the batch and says in
// words what is wrong.
#pragma once

#include <vector>

#include "order.hpp"
#include "targets.hpp"

namespace handmap {

using Landmarks = std::array<Vec3, kLandmarks>;

inline Landmarks landmarks_of(const double* p) {
  Landmarks points;
  for (Vec3& point : points) {
    point = {p[0], p[1], p[2]};
    p += 3;
  }
  return points;
}

// Places in the state; the numbers of Python are at most those. One more than the batches of the past,
// so that the next one replaces none that is still needed.
constexpr int kMostSamples = 32, kMostPast = 5, kMostSizes = 8;
constexpr int kPairs = 26, kFingers = 5;
// Coordinates beyond this are left to Python [m]: here nothing overflows.
constexpr double kTooFar = 1e6;

struct BatchSize {
  int most, least;
  double time;
};

// Numbers of Python.
struct InputRules {
  // plausibility
  BatchSize fresh, calm, alert;
  int calm_batches, carried_batches, first_sizes;
  double sure_side, backwards, otherwise_right, same_misfit, resized, refused_share, brief;
  double shortest_step, longest_step, shortest_hand, longest_hand;
  double no_hand, better_by, contradiction;
  // hand_geometry
  double centres[kPairs], widths[kPairs], feature_sizes[5];
  double largest_deviation, rigid_spread, quartiles_apart, hyperextension;
  double least_trembling, stuck, carried, step, others_change, most_bent, least_bent;
  // The 26 pairs of our own order, and then those that other orders need.
  std::vector<int> first, second;
  // Of each other order, where its pairs are: pair by pair, the orders of one behind each other.
  std::vector<int> places;
  int orders;
  // wrist_axes
  std::vector<Mat3> conventions;
  double farthest, steady, turned, kept, farthest_apart;
};

// Sort every column of rows (n, width): Batcher's merge exchange (Knuth, 5.2.2, algorithm M).
inline void sort_columns(double* rows, int n, int width) {
  int top = 1;
  while (2 * top < n) top *= 2;
  for (int p = n > 1 ? top : 0; p > 0; p /= 2) {
    for (int q = top, r = 0, d = p; d > 0; d = q - p, q /= 2, r = p) {
      for (int i = 0; i + d < n; ++i) {
        if ((i & p) != r) continue;
        double *a = rows + i * width, *b = rows + (i + d) * width;
        for (int c = 0; c < width; ++c) {
          const double low = a[c] < b[c] ? a[c] : b[c], high = a[c] < b[c] ? b[c] : a[c];
          a[c] = low;
          b[c] = high;
        }
      }
      if (q == p) break;
    }
  }
}

inline Vec3 unit(const Vec3& v) { return (1.0 / std::max(norm(v), 1e-9)) * v; }

// Logarithms of the distances of some pairs over some samples, and how much they vary.
struct Distances {
  std::vector<double> medians, spreads;
};

// Measure the pairs of `rules` with numbers in [from, to).
inline void measure_pairs(const InputRules& rules, const Landmarks* hands, int n, int from, int to,
                    Distances& found) {
  const int width = to - from;
  std::vector<double> squares(n * width);
  for (int t = 0; t < n; ++t)
    for (int k = 0; k < width; ++k) {
      const Vec3 apart = hands[t][rules.first[from + k]] - hands[t][rules.second[from + k]];
      squares[t * width + k] = dot(apart, apart);
    }
  sort_columns(squares.data(), n, width);
  const auto log_of = [&](int row, int k) {
    return 0.5 * std::log(std::max(squares[row * width + k], 1e-24));
  };
  found.medians.resize(to);
  found.spreads.resize(to);
  for (int k = 0; k < width; ++k) {
    found.medians[from + k] = log_of(n / 2, k);
    found.spreads[from + k] =
        (log_of(n - 1 - n / 4, k) - log_of(n / 4, k)) / rules.quartiles_apart;
  }
}

// How badly distances fit a hand in our order; `rigid` is false to leave out their spreads.
inline double misfit(const InputRules& rules, const Distances& distances, double middle,
                     bool rigid) {
  const double most = rules.largest_deviation * rules.largest_deviation;
  double sum = 0.0;
  for (int i = 0; i < kPairs; ++i) {
    const double off = (distances.medians[i] - rules.centres[i] - middle) / rules.widths[i];
    const double soft = rigid ? distances.spreads[i] / rules.rigid_spread : 0.0;
    sum += std::min(off * off + soft * soft, most);
  }
  return std::sqrt(sum / kPairs);
}

// The least misfit of all other orders.
inline double least_misfit(const InputRules& rules, const Distances& distances) {
  const int K = rules.orders;
  const double most = rules.largest_deviation * rules.largest_deviation;
  std::vector<double> deviations(kPairs * K), sums(K, 0.0);
  for (int i = 0; i < kPairs; ++i)
    for (int k = 0; k < K; ++k)
      deviations[i * K + k] = distances.medians[rules.places[i * K + k]] - rules.centres[i];
  std::vector<double> sorted = deviations;
  sort_columns(sorted.data(), kPairs, K);
  const double* middles = sorted.data() + kPairs / 2 * K;
  for (int i = 0; i < kPairs; ++i)
    for (int k = 0; k < K; ++k) {
      const double off = (deviations[i * K + k] - middles[k]) / rules.widths[i];
      const double soft = distances.spreads[rules.places[i * K + k]] / rules.rigid_spread;
      const double square = off * off + soft * soft;
      sums[k] += square < most ? square : most;
    }
  return std::sqrt(*std::min_element(sums.begin(), sums.end()) / kPairs);
}

// Evidence for a right hand in one sample.
struct PalmarEvidence {
  double total, fingers;
};

inline PalmarEvidence palmar_evidence(const InputRules& rules, const Landmarks& hand) {
  const auto offset = [&](int i) { return hand[i] - hand[0]; };
  const Vec3 along = offset(9), palmar = unit(cross(offset(5), offset(17)));
  const Vec3 axis = cross(unit(along), palmar);
  const double size = std::max(norm(along), 1e-12);
  const auto height = [&](int i) { return dot(offset(i), palmar) / size; };
  double bends = 0.0, bent = 0.0;
  for (int base = 5; base < kLandmarks; base += 4) {
    const Vec3 first = unit(hand[base + 1] - hand[base]);
    const Vec3 second = unit(hand[base + 2] - hand[base + 1]);
    bends += 0.25 * dot(cross(first, second), axis);
    bent += 0.25 * dot(first, palmar);
  }
  const double limit = rules.hyperextension;
  const double features[5] = {height(1), -0.5 * (height(9) + height(13)), height(2), bends,
                              bent - clip(bent, -limit, limit)};
  double evidence[5];
  for (int i = 0; i < 5; ++i) evidence[i] = clip(features[i] / rules.feature_sizes[i], -1.0, 1.0);
  const double fingers = evidence[3] + evidence[4];
  return {evidence[0] + evidence[1] + evidence[2] + fingers, fingers};
}

// Whether a finger repeats to rounding while most others tremble, or a bone has no length.
inline bool has_stuck_finger(const InputRules& rules, const Landmarks* hands, int n) {
  double trembling[kFingers];
  bool is_carried[kFingers];
  for (int f = 0; f < kFingers; ++f) {
    trembling[f] = 0.0;
    for (int k = 4 * f + 2; k < 4 * f + 4; ++k) {
      double least = HUGE_VAL, most = 0.0, sum = 0.0;
      for (int t = 0; t < n; ++t) {
        const Vec3 bone = hands[t][k + 1] - hands[t][k];
        const double square = dot(bone, bone);
        least = std::min(least, square);
        most = std::max(most, square);
        sum += square;
      }
      if (sum == 0.0) return true;
      trembling[f] = std::max(trembling[f], (most - least) / (sum / n));
    }
    is_carried[f] = false;
    for (int t = 1; t < n; ++t) {
      const Vec3 moved = hands[t][4 * f + 4] - hands[0][4 * f + 4];
      is_carried[f] = is_carried[f] || moved.x != 0.0 || moved.y != 0.0 || moved.z != 0.0;
    }
  }
  double sorted[kFingers];
  std::copy(trembling, trembling + kFingers, sorted);
  const double usual = upper_median(sorted, kFingers);
  for (int f = 0; f < kFingers; ++f)
    if (trembling[f] < rules.stuck * usual && is_carried[f] && usual > rules.least_trembling)
      return true;
  return false;
}

// What a batch is compared with.
struct Examined {
  double misfit = std::numeric_limits<double>::quiet_NaN();
  int size_count = 0;
  double sizes[kMostSizes];
  // The last batches in a ring, the oldest at `past_first`.
  int past_count = 0, past_first = 0;
  int past_sizes[kMostPast];
  Landmarks past[kMostPast][kMostSamples];
  bool has_start = false, is_proven = false, has_curled = false;
  Mat3 start_palm, start_mean;

  template <class Visit>
  void each_past(const Visit& visit) const {
    for (int b = 0; b < past_count; ++b) {
      const int at = (past_first + b) % kMostPast;
      for (int t = 0; t < past_sizes[at]; ++t) visit(past[at][t]);
    }
  }
  void append_past(const InputRules& rules, const Landmarks* hands, int n) {
    const int at = (past_first + past_count) % kMostPast;
    std::copy(hands, hands + n, past[at]);
    past_sizes[at] = n;
    ++past_count;
    if (past_count > rules.carried_batches) {
      past_first = (past_first + 1) % kMostPast;
      --past_count;
    }
  }
};

constexpr int kSpans = 9;
// Distances of three joints of a finger to three landmarks of the palm.
inline double span(const Landmarks& hand, int finger, int i) {
  constexpr int kTo[3] = {0, 5, 17};
  return norm(hand[4 * finger + 2 + i / 3] - hand[kTo[i % 3]]);
}

// Whether the palm carries a bent finger as it is while the other fingers move.
inline bool has_carried_finger(const InputRules& rules, const Examined& seen) {
  bool is_carried[kFingers] = {}, any = false;
  for (int f = 0; f < kFingers; ++f) {
    bool is_rigid = true;
    for (int i = 0; i < kSpans && is_rigid; ++i) {
      double least = HUGE_VAL, most = 0.0;
      seen.each_past([&](const Landmarks& hand) {
        if (most - least >= rules.carried) return;
        const double away = span(hand, f, i);
        least = std::min(least, away);
        most = std::max(most, away);
      });
      is_rigid = most - least < rules.carried;
    }
    if (!is_rigid) continue;
    const int last = (seen.past_first + seen.past_count - 1) % kMostPast;
    const Landmarks& hand = seen.past[last][seen.past_sizes[last] - 1];
    Vec3 bones[3];
    for (int k = 0; k < 3; ++k) bones[k] = unit(hand[4 * f + 2 + k] - hand[4 * f + 1 + k]);
    for (int k = 0; k < 2; ++k) {
      const double bend = dot(bones[k + 1], bones[k]);
      is_carried[f] = is_carried[f] || (bend > rules.most_bent && bend < rules.least_bent);
    }
    any = any || is_carried[f];
  }
  if (!any) return false;
  double changing[kFingers] = {};
  int steps = -1;
  double former[kFingers][kSpans];
  seen.each_past([&](const Landmarks& hand) {
    ++steps;
    for (int f = 0; f < kFingers; ++f) {
      bool changes = false;
      for (int i = 0; i < kSpans; ++i) {
        const double away = span(hand, f, i);
        changes = changes || (steps > 0 && std::abs(away - former[f][i]) > rules.step);
        former[f][i] = away;
      }
      changing[f] += changes;
    }
  });
  return upper_median(changing, kFingers) > rules.others_change * steps;
}

inline double cosine(const Mat3& a, const Mat3& b) {
  double sum = 0.0;
  for (int i = 0; i < 9; ++i) sum += a.m[i] * b.m[i];
  return clip((sum - 1.0) / 2.0, -1.0, 1.0);
}

// The palm's rotation: +y distal, +z dorsal.
inline Mat3 palm_axes(const Landmarks& hand, double sign) {
  const Vec3 dorsal = unit(-sign * cross(hand[5] - hand[0], hand[17] - hand[0]));
  const Vec3 lateral = unit(cross(hand[9] - hand[0], dorsal));
  const Vec3 distal = cross(dorsal, lateral);
  return {{lateral.x, distal.x, dorsal.x, lateral.y, distal.y, dorsal.y, lateral.z, distal.z,
           dorsal.z}};
}

// Whether wrist poses belong to the landmarks, with axes that are known. `seen` learns of them.
inline bool follows_palm(const InputRules& rules, double sign, const Landmarks* hands,
                         const Pose* wrists, int n, Examined& seen) {
  double apart[kMostSamples];
  for (int t = 0; t < n; ++t) apart[t] = norm(wrists[t].p - hands[t][0]);
  if (!(upper_median(apart, n) <= rules.farthest_apart)) return false;
  Mat3 palms = 0.0 * Mat3{}, halves[2] = {palms, palms};
  for (int t = 0; t < n; ++t) {
    const Mat3 palm = palm_axes(hands[t], sign);
    Mat3& half = halves[t < n / 2 ? 0 : 1];
    palms = palms + palm;
    half = half + transposed(palm) * wrists[t].R;
  }
  const Mat3 mean = nearest_rotation(halves[0] + halves[1]), palm = nearest_rotation(palms);
  const double steadiness =
      n < 2 ? 1.0 : cosine(nearest_rotation(halves[0]), nearest_rotation(halves[1]));
  const Mat3 start_palm = seen.has_start ? seen.start_palm : palm;
  const Mat3 start_mean = seen.has_start ? seen.start_mean : mean;
  const double kept = cosine(mean, start_mean);
  bool is_known = false;
  for (const Mat3& axes : rules.conventions)
    is_known = is_known || cosine(axes, mean) > rules.farthest;
  if (!(steadiness > rules.steady && kept > rules.steady && is_known)) return false;
  const double turn = std::acos(cosine(palm, start_palm)), change = std::acos(kept);
  seen.has_start = true;
  seen.start_palm = start_palm;
  seen.start_mean = start_mean;
  seen.is_proven = seen.is_proven || (cosine(mean, rules.conventions[0]) > rules.farthest &&
                                      turn > rules.turned && change < rules.kept * turn);
  return true;
}

// Whether landmarks are in metres, given that their order is ours.
inline bool is_in_metres(const InputRules& rules, const Distances& own, const Landmarks* hands,
                         int n) {
  double length = 0.0, depth = 0.0;
  for (int i = 8; i < 12; ++i) length += std::exp(own.medians[i]);
  Vec3 least = hands[0][0], most = least;
  for (int t = 0; t < n; ++t)
    for (int i = 0; i < 3; ++i) {
      least[i] = std::min(least[i], hands[t][0][i]);
      most[i] = std::max(most[i], hands[t][0][i]);
      if (i == 2) depth = std::max(depth, std::abs(hands[t][0].z));
    }
  const double moved = std::max(most.x - least.x, most.y - least.y);
  const bool is_image = depth < 1e-4 * length && 1e-4 * length < moved;
  return !is_image && length >= rules.shortest_hand && length <= rules.longest_hand;
}

// Whether a batch is surely a hand as it is said to be, which then `seen` learns of.
inline bool is_plausible(const InputRules& rules, double sign, const Landmarks* hands,
                         const Pose* wrists, int n, Examined& seen) {
  double total[kMostSamples], fingers[kMostSamples];
  for (int t = 0; t < n; ++t) {
    for (const Vec3& p : hands[t])
      if (!(std::abs(p.x) < kTooFar && std::abs(p.y) < kTooFar && std::abs(p.z) < kTooFar)) return false;
    const PalmarEvidence evidence = palmar_evidence(rules, hands[t]);
    total[t] = sign * evidence.total;
    fingers[t] = sign * evidence.fingers;
  }
  const double side = upper_median(total, n), bent = upper_median(fingers, n);
  Distances distances;
  measure_pairs(rules, hands, n, 0, kPairs, distances);
  double deviations[kPairs];
  for (int i = 0; i < kPairs; ++i) deviations[i] = distances.medians[i] - rules.centres[i];
  const double size = upper_median(deviations, kPairs);
  const double own = misfit(rules, distances, size, true);
  // A misfit of before that is NaN is none.
  const bool is_known = own < seen.misfit + rules.same_misfit && side > rules.sure_side;
  if (!is_known) {
    measure_pairs(rules, hands, n, kPairs, static_cast<int>(rules.first.size()), distances);
    const double needed = side > -rules.contradiction ? own - rules.better_by : own;
    if (!(least_misfit(rules, distances) >= needed) ||
        !(misfit(rules, distances, size, false) <= rules.no_hand))
      return false;
  }
  if (!is_in_metres(rules, distances, hands, n)) return false;
  if ((bent <= rules.backwards && side - bent > rules.otherwise_right) || side < -rules.sure_side)
    return false;
  if (has_stuck_finger(rules, hands, n)) return false;
  double sizes[kMostSizes];
  int count = seen.size_count;
  std::copy(seen.sizes, seen.sizes + count, sizes);
  if (count < rules.first_sizes) sizes[count++] = size;
  const double ratio = std::exp(size - upper_median(sizes, count));
  if (!(ratio > 1.0 / rules.resized && ratio < rules.resized)) return false;
  const int past_count = seen.past_count, past_first = seen.past_first;
  seen.append_past(rules, hands, n);
  const bool is_carried =
      seen.past_count == rules.carried_batches && has_carried_finger(rules, seen);
  if (is_carried || (wrists && !follows_palm(rules, sign, hands, wrists, n, seen))) {
    seen.past_count = past_count;
    seen.past_first = past_first;
    return false;
  }
  if (count > seen.size_count) seen.sizes[seen.size_count++] = size;
  if (!is_known) seen.misfit = own;
  seen.has_curled = seen.has_curled || bent >= -rules.backwards;
  return true;
}

// What Python says about input that the core cannot prove to be a hand: findings by their numbers,
// none by `kNone`. It takes the GIL, and throws what Python raises.
constexpr int kNone = -1;

class Explainer {
 public:
  virtual ~Explainer() = default;
  virtual int explain_times(const double* times, int n) = 0;
  virtual int explain_rate(double rate) = 0;
  virtual int explain_batch(const Landmarks* hands, const Pose* wrists, int n,
                            Examined& seen) = 0;
  // The rule (`Rule`) that a finding is named by.
  virtual int rule_of(int finding) const = 0;
};

struct InputState {
  // The batch so far.
  int count = 0, wrist_count = 0;
  double times[kMostSamples];
  Landmarks hands[kMostSamples];
  Pose wrists[kMostSamples];
  bool has_last_time = false;
  double last_time = 0.0;
  int guess = kNone, finding = kNone, batches = 0, calm = 0;
  Examined seen{};
};

// See plausibility.InputCheck.
class InputCheck {
 public:
  const InputRules& rules;
  double sign;
  Explainer& explainer;
  InputState state{};

  InputCheck(const InputRules& own_rules, double own_sign, Explainer& own_explainer)
      : rules(own_rules), sign(own_sign), explainer(own_explainer) {}

  // The number of the finding so far.
  int update(double time, const Landmarks& landmarks, const Pose* wrist) {
    const int i = state.count++;
    state.times[i] = time;
    state.hands[i] = landmarks;
    if (wrist) state.wrists[state.wrist_count++] = *wrist;
    if (is_complete()) judge();
    return state.finding;
  }

  void alert() {
    clear();
    state.calm = -rules.calm_batches;
  }

  int finish() {
    if (state.count > 0 && (state.count >= rules.fresh.least || state.batches == 0)) judge();
    clear();
    return state.batches == 1 ? state.guess : state.finding;
  }

 private:
  void clear() { state.count = state.wrist_count = 0; }

  bool is_complete() const {
    const BatchSize* size = &rules.alert;
    if (state.calm >= 0 && state.finding == kNone) {
      const bool is_calm = state.seen.is_proven || state.wrist_count < state.count;
      size = is_calm && state.calm >= rules.calm_batches ? &rules.calm : &rules.fresh;
    }
    const double duration = state.times[state.count - 1] - state.times[0];
    return state.count >= size->most || (state.count >= size->least && duration >= size->time);
  }

  bool are_seconds(const double* times, int n) const {
    if (n < 2) return true;
    double steps[kMostSamples];
    for (int i = 0; i + 1 < n; ++i) steps[i] = times[i + 1] - times[i];
    const double step = upper_median(steps, n - 1);
    return step <= 0.0 || (step >= rules.shortest_step && step <= rules.longest_step);
  }

  void judge() {
    const bool has_wrists = state.wrist_count == state.count;
    double times[kMostSamples + 1];
    int n = 0, hands = 0;
    if (state.has_last_time) times[n++] = state.last_time;
    for (int i = 0; i < state.count; ++i) {
      times[n++] = state.times[i];
      const Vec3 palm = state.hands[i][9] - state.hands[i][0];
      // The same point 21 times is what trackers send where they lost the hand.
      if (!(std::abs(palm.x) + std::abs(palm.y) + std::abs(palm.z) > 1e-9)) continue;
      state.hands[hands] = state.hands[i];
      state.wrists[hands++] = state.wrists[i];
    }
    clear();
    ++state.batches;
    state.has_last_time = true;
    state.last_time = times[n - 1];
    const Pose* wrists = has_wrists ? state.wrists : nullptr;
    int guess = are_seconds(times, n) ? kNone : explainer.explain_times(times, n);
    if (guess == kNone && hands > 0 &&
        !is_plausible(rules, sign, state.hands, wrists, hands, state.seen))
      guess = explainer.explain_batch(state.hands, wrists, hands, state.seen);
    const bool is_same = (guess == kNone) == (state.guess == kNone) && state.batches > 1;
    state.calm = is_same || state.calm < 0 ? state.calm + 1 : 0;
    if (is_same) state.finding = guess;
    state.guess = guess;
  }
};

}  // namespace handmap
