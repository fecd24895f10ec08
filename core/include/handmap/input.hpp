// Tells wrong input from a human hand, in the first second and at every sample after it.
//
// Landmarks in another order, the other hand, a mirrored world, millimetres, milliseconds, fingers that
// bend backwards or a wrist quaternion in another order map without an error, to nonsense. `InputCheck`
// measures what a human hand cannot do in small batches of samples, and asks which mistake explains it.
#pragma once

#include "finding.hpp"
#include "hand_geometry.hpp"
#include "wrist_axes.hpp"

namespace handmap {

// When a batch is complete: at `most` samples, or at `least` ones after a time [s].
struct BatchSize {
  int most, least;
  double time;
};
constexpr BatchSize kFreshBatch = {16, 8, 0.25};  // while the finding is new
constexpr BatchSize kCalmBatch = {32, 16, 0.5};
// After `alert`: two such batches are shorter than the guard's hold after a flip.
constexpr BatchSize kAlertBatch = {16, 6, 0.19};
constexpr int kCalmBatches = 2;  // after which the finding is no longer new
static_assert(kCalmBatch.most <= kMostSamples);

constexpr double kSureSide = 0.6;  // of 5 (`PalmarEvidence::total`)
// Of 2 (`PalmarEvidence::fingers`): beyond the hyperextension of people.
constexpr double kBackwards = -0.95;
constexpr double kOtherwiseRight = 0.25;  // of 3: what palm and thumb must say for backward fingers
constexpr double kSameMisfit = 0.12;  // a misfit that rises by less needs no new search for orders
constexpr int kCarriedBatches = 4;  // 2 s or more: what tells a finger at rest from one that is stuck
constexpr int kFirstSizes = 8;      // batches at the start that say how large the hand is
constexpr double kResized = 1.35;   // as large as at the start, or as small; 0.86 to 1.25 in people
constexpr double kRefusedShare = 0.25;   // of a recording's valid samples
constexpr double kShortRecording = 1.0;  // judged by its last batches up to this time [s]

// A misfit that no hand has: at most 1.2 in recordings.
constexpr double kNoHand = 1.45;
// An order must fit better than ours by this much. Real recordings fit no other order better.
constexpr double kBetterBy = 0.12;
constexpr double kNoisyMisfit = 15.0;  // what noise adds to both [1/m]
// Of 5 (`PalmarEvidence::total`): the order or the side cannot be right.
constexpr double kContradiction = 0.6;

// Shortest and longest median time between samples [s]: from 2500 Hz to 2 Hz.
constexpr double kSampleSteps[2] = {4e-4, 0.5};
// Lengths that a hand may have [m], from wrist to middle fingertip: from a child's of five years to more
// than those of nearly all men. Adults that were tracked have 0.175 to 0.195.
constexpr double kHandLengths[2] = {0.12, 0.25};

// Image coordinates have no depth: the z of MediaPipe's image landmarks is relative to the wrist's.
inline bool is_image(const Landmarks* hands, int n, double length) {
  Vec3 least = hands[0][0], most = least;
  double depth = 0.0;
  for (int t = 0; t < n; ++t) {
    for (int i = 0; i < 2; ++i) {
      least[i] = std::min(least[i], hands[t][0][i]);
      most[i] = std::max(most[i], hands[t][0][i]);
    }
    depth = std::max(depth, std::abs(hands[t][0].z));
  }
  const double moved = std::max(most.x - least.x, most.y - least.y);
  return depth < 1e-4 * length && 1e-4 * length < moved;
}

// The largest extent of a hand along an axis, the median over samples [m].
inline double extent_of(const Landmarks* hands, int n) {
  double extents[kMostSamples] = {};
  for (int t = 0; t < n; ++t)
    for (int axis = 0; axis < 3; ++axis) {
      const auto [least, most] = std::minmax_element(
          hands[t].begin(), hands[t].end(),
          [axis](const Vec3& a, const Vec3& b) { return a[axis] < b[axis]; });
      extents[t] = std::max(extents[t], (*most)[axis] - (*least)[axis]);
    }
  return median(extents, n);
}

// Tell whether landmarks, which are a hand or in another order, are not in metres.
inline Finding find_length_unit(const Distances& distances, const Landmarks* hands, int n,
                                bool is_hand) {
  const double length = distances.hand_length();
  if (is_image(hands, n, length)) return {Mistake::image};
  if (kHandLengths[0] <= length && length <= kHandLengths[1]) return {};
  if (!is_hand) {
    // Landmarks of the size of a hand may be in another order.
    const double extent = extent_of(hands, n);
    if (kHandLengths[0] / 2.0 < extent && extent < kHandLengths[1]) return {};
  }
  return {Mistake::length, length};
}

// How much noise adds to the misfits of a batch.
inline double misfit_of_noise(const Landmarks* hands, int n) {
  if (n < 3) return 0.0;
  double changes[(kMostSamples - 2) * kLandmarks];
  int count = 0;
  for (int t = 2; t < n; ++t)
    for (int i = 0; i < kLandmarks; ++i) {
      const auto offset = [&](int at) { return hands[at][i] - hands[at][0]; };
      changes[count++] = norm((offset(t) - offset(t - 1)) - (offset(t - 1) - offset(t - 2)));
    }
  return kNoisyMisfit * noise_of(changes, count, change_rate(1.0, 1.0));
}

// Evidence for a right hand, of landmarks in some order; the median over samples.
inline double evidence_in_order(const std::array<int, kLandmarks>& order, const Landmarks* hands,
                                int n) {
  double totals[kMostSamples];
  for (int t = 0; t < n; ++t) {
    Landmarks ordered;
    for (int i = 0; i < kLandmarks; ++i) ordered[i] = hands[t][order[i]];
    totals[t] = palmar_evidence(ordered).total;
  }
  return median(totals, n);
}

// Memory in which batches are examined.
struct BatchWork {
  Distances distances;
  Misfits misfits;
  Indices better;  // orders that explain landmarks better than ours

  explicit BatchWork(const LandmarkOrders& orders) {
    distances.reserve(orders.pairs.size(), kMostSamples);
    misfits.reserve(orders.orders.size());
    better.reserve(orders.orders.size());
  }
};

// Look for an order that explains landmarks much better than ours, whose evidence is -5 to 5.
inline Finding find_order(const LandmarkOrders& orders, BatchWork& work, double sign,
                          double own_evidence, const Landmarks* hands, int n) {
  Distances& distances = work.distances;
  distances.measure(orders.pairs.data(), kPairs, static_cast<int>(orders.pairs.size()), hands, n);
  work.misfits.measure(distances, orders);
  const Vector& all = work.misfits.of_orders;
  const double own = all[0], slack = misfit_of_noise(hands, n);
  // The other hand is an explanation too, so an order of fingers must beat it only where our own order
  // contradicts the side.
  const double needed = own - slack - (own_evidence > -kContradiction ? kBetterBy : 0.0);
  Indices& better = work.better;
  better.clear();
  for (size_t k = 0; k < all.size(); ++k)
    if (all[k] < needed) better.push_back(static_cast<int>(k));
  // Of those that fit alike, the first one is first.
  std::sort(better.begin(), better.end(),
            [&](int a, int b) { return all[a] != all[b] ? all[a] < all[b] : a < b; });
  const auto named = [](bool is_hand, int order) -> Finding {
    if (!is_hand || order == 0) return {Mistake::unknown_order};
    return {Mistake::order, kNaN, order};
  };
  for (const int k : better) {
    const double evidence = sign * evidence_in_order(orders.orders[k], hands, n);
    if (evidence > std::min(-kContradiction, own_evidence)) return named(all[k] < kNoHand, k);
  }
  if (misfit(distances, false) <= kNoHand + slack) return {};
  const auto best = std::min_element(all.begin(), all.end());
  return named(*best < std::min(kNoHand, own - 3.0 * kBetterBy),
               static_cast<int>(best - all.begin()));
}

// What is remembered of the batches before.
struct Examined {
  double misfit = kNaN;
  bool has_curled = false;
  int size_count = 0;
  double sizes[kFirstSizes];
  // The last batches in a ring, the next one at `past_next`.
  int past_count = 0, past_next = 0;
  int past_sizes[kCarriedBatches];
  Landmarks past[kCarriedBatches][kMostSamples];
  WristCheck wrist;
};

// Tell whether a finger repeats, by this batch or by the last ones together.
inline Finding find_stuck(const Landmarks* hands, int n, Examined& seen) {
  std::copy(hands, hands + n, seen.past[seen.past_next]);
  seen.past_sizes[seen.past_next] = n;
  seen.past_next = (seen.past_next + 1) % kCarriedBatches;
  seen.past_count = std::min(seen.past_count + 1, kCarriedBatches);
  int finger = stuck_finger(hands, n);
  if (seen.past_count == kCarriedBatches) {
    const Landmarks* all[kCarriedBatches * kMostSamples];
    size_t count = 0;
    for (int b = 0; b < kCarriedBatches; ++b) {
      const int at = (seen.past_next + b) % kCarriedBatches;
      for (int t = 0; t < seen.past_sizes[at]; ++t) all[count++] = &seen.past[at][t];
    }
    const int carried = carried_finger(all, count);
    if (carried >= 0 && (finger < 0 || carried < finger)) finger = carried;
  }
  if (finger < 0) return {};
  return {Mistake::stuck, kNaN, finger};
}

// Compare the logarithm of the hand's size with that of the first batches.
inline Finding find_resized(double size, Examined& seen) {
  if (seen.size_count < kFirstSizes) seen.sizes[seen.size_count++] = size;
  double sizes[kFirstSizes];
  std::copy(seen.sizes, seen.sizes + seen.size_count, sizes);
  const double ratio = std::exp(size - upper_median(sizes, seen.size_count));
  if (1.0 / kResized < ratio && ratio < kResized) return {};
  return {Mistake::resized, ratio};
}

// Tell the other hand from a mirrored world, which only the wrist's orientation can.
inline Finding other_side(double sign, const Landmarks* hands, const Pose* wrists, int n) {
  if (!wrists) return {Mistake::other_side};
  const bool is_other = WristCheck().examine(-sign, hands, wrists, n).is_none();
  return {is_other ? Mistake::other_hand : Mistake::mirrored};
}

// What is wrong in one batch. `wrists` is null where one is missing.
inline Finding examine(const LandmarkOrders& orders, double sign, const Landmarks* hands,
                       const Pose* wrists, int n, Examined& seen, BatchWork& work) {
  double totals[kMostSamples], of_fingers[kMostSamples];
  for (int t = 0; t < n; ++t) {
    const PalmarEvidence evidence = palmar_evidence(hands[t]);
    totals[t] = sign * evidence.total;
    of_fingers[t] = sign * evidence.fingers;
  }
  const double total = upper_median(totals, n);
  const double fingers = upper_median(of_fingers, n);
  Distances& distances = work.distances;
  distances.measure(orders.pairs.data(), 0, kPairs, hands, n);
  const double own = misfit(distances, true);
  // A misfit of before that is NaN is none.
  const bool is_known = own < seen.misfit + kSameMisfit && total > kSureSide;
  const Finding order =
      is_known ? Finding{} : find_order(orders, work, sign, total, hands, n);
  const Finding unit = find_length_unit(distances, hands, n, order.is_none());
  if (!unit.is_none()) return unit;
  if (!order.is_none()) return order;
  // Fingers that were seen to curl are bent backwards by the person.
  const bool is_back = fingers <= kBackwards && !seen.has_curled;
  if (is_back && total - fingers > kOtherwiseRight) return {Mistake::flexion};
  if (total < -kSureSide) return other_side(sign, hands, wrists, n);
  if (!is_known) seen.misfit = own;
  seen.has_curled = seen.has_curled || fingers >= -kBackwards;
  const Finding stuck = find_stuck(hands, n, seen);
  if (!stuck.is_none()) return stuck;
  const Finding resized = find_resized(distances.log_size(), seen);
  if (!resized.is_none() || !wrists) return resized;
  return seen.wrist.examine(sign, hands, wrists, n);
}

// Tell whether the median step of instants is not one of a tracker in seconds.
inline Finding find_time_unit(const double* times, int n) {
  if (n < 2) return {};
  double steps[kMostSamples];
  for (int i = 0; i + 1 < n; ++i) steps[i] = times[i + 1] - times[i];
  const double step = upper_median(steps, n - 1);
  if (step <= 0.0 || (kSampleSteps[0] <= step && step <= kSampleSteps[1])) return {};
  return {Mistake::step, step};
}

// Checks one hand's samples as they come. Samples are collected into batches of 16, or of a quarter of a
// second for a slow tracker, and of twice as many once nothing changes any more. Two batches in a row
// must agree before the finding changes, so one bad sample changes nothing.
class InputCheck {
 public:
  // What it remembers; a copy goes on from there.
  struct State {
    // The batch so far.
    int count = 0, wrist_count = 0;
    double times[kMostSamples];
    Landmarks hands[kMostSamples];
    Pose wrists[kMostSamples];
    bool has_last_time = false;
    double last_time = 0.0;
    Finding guess, finding;
    int batches = 0, calm = 0;
    Examined seen;

    // Whether counts are in their ranges, which those of a damaged copy may not be.
    bool is_sound() const {
      const auto is_within = [](int value, int most) { return 0 <= value && value <= most; };
      for (const int size : seen.past_sizes)
        if (!is_within(size, kMostSamples)) return false;
      for (const Finding& each : {guess, finding})
        if (!each.is_sound()) return false;
      return is_within(count, kMostSamples - 1) && is_within(wrist_count, count) &&
             is_within(seen.size_count, kFirstSizes) &&
             is_within(seen.past_count, kCarriedBatches) &&
             is_within(seen.past_next, kCarriedBatches - 1);
    }
  };
  State state{};

  // The sign is 1 for a right hand, -1 for a left one.
  InputCheck(double sign, std::shared_ptr<const LandmarkOrders> orders)
      : sign_(sign), orders_(std::move(orders)), work_(*orders_) {}

  // Take a sample in which the tracker saw the hand; return the finding so far.
  const Finding& update(double time, const Landmarks& landmarks, const Pose* wrist) {
    const int i = state.count++;
    state.times[i] = time;
    state.hands[i] = landmarks;
    if (wrist) state.wrists[state.wrist_count++] = *wrist;
    if (is_complete()) judge();
    return state.finding;
  }

  // Judge the next samples by themselves and soon: something has changed.
  void alert() {
    clear();
    state.calm = -kCalmBatches;
  }

  // Judge what is left at the end of a recording, by one batch if there was no other.
  const Finding& finish() {
    if (state.count > 0 && (state.count >= kFreshBatch.least || state.batches == 0)) judge();
    clear();
    return state.batches == 1 ? state.guess : state.finding;
  }

 private:
  double sign_;
  std::shared_ptr<const LandmarkOrders> orders_;
  BatchWork work_;

  void clear() { state.count = state.wrist_count = 0; }

  bool is_complete() const {
    BatchSize size = kAlertBatch;
    if (state.calm >= 0 && state.finding.is_none()) {
      const bool is_calm = state.seen.wrist.is_proven || state.wrist_count < state.count;
      size = is_calm && state.calm >= kCalmBatches ? kCalmBatch : kFreshBatch;
    }
    const double duration = state.times[state.count - 1] - state.times[0];
    // A batch that began with wrists may have grown beyond the number of one without.
    return state.count >= size.most || (state.count >= size.least && duration >= size.time);
  }

  // Examine the collected samples, and change the finding if two batches agree.
  void judge() {
    const bool has_wrists = state.wrist_count == state.count;
    double times[kMostSamples + 1];
    int n = 0, hands = 0;
    if (state.has_last_time) times[n++] = state.last_time;
    for (int i = 0; i < state.count; ++i) {
      times[n++] = state.times[i];
      // Where trackers lost the hand, they send one point 21 times: that has rules of its own.
      if (!(norm(state.hands[i][9] - state.hands[i][0]) > 1e-9)) continue;
      state.hands[hands] = state.hands[i];
      state.wrists[hands++] = state.wrists[i];
    }
    clear();
    ++state.batches;
    state.has_last_time = true;
    state.last_time = times[n - 1];
    Finding guess = find_time_unit(times, n);
    if (guess.is_none() && hands > 0) {
      const Pose* wrists = has_wrists ? state.wrists : nullptr;
      guess = examine(*orders_, sign_, state.hands, wrists, hands, state.seen, work_);
    }
    // Two batches in a row must agree that something is wrong, or that nothing is.
    const bool is_same = guess.is_none() == state.guess.is_none() && state.batches > 1;
    state.calm = is_same || state.calm < 0 ? state.calm + 1 : 0;
    if (is_same) state.finding = guess;
    state.guess = guess;
  }
};

}  // namespace handmap
