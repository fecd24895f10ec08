// Measures of 21 landmarks that tell a hand in the right order from anything else.
//
// All of them are ratios or angles, so that they hold for every hand and in every unit of length:
// - the distances between neighbouring landmarks, which bones and palm keep (`Distances`, `misfit`),
// - the side of the palm's plane on which thumb and bent fingers lie (`palmar_evidence`), which is
//   opposite on a left hand, in a mirrored world and where fingers bend backwards.
#pragma once

#include <map>
#include <string>
#include <utility>
#include <vector>

#include "noise.hpp"
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

// Landmarks at both ends of each bone, and from the wrist to each finger's first joint; then
// neighbouring MCP joints; then diagonals of the palm.
constexpr int kBones = 20, kFixed = 23, kPairs = 26, kFingers = 5;
constexpr int kEnds[kPairs][2] = {
    {0, 1},   {1, 2},   {2, 3},   {3, 4},   {0, 5},   {5, 6},   {6, 7},   {7, 8},   {0, 9},
    {9, 10},  {10, 11}, {11, 12}, {0, 13},  {13, 14}, {14, 15}, {15, 16}, {0, 17},  {17, 18},
    {18, 19}, {19, 20}, {5, 9},   {9, 13},  {13, 17}, {1, 5},   {1, 17},  {5, 17}};

// Centre and half width of log(distance / median distance) of these pairs. From six recordings of four
// trackers (WebXR headset, two Leap generations, MediaPipe), the human model's own proportions, and
// those of Buchholz et al. 1992. Half widths have a margin of 0.05 and are at least 0.12.
constexpr double kCentres[kPairs] = {
    0.14,  0.13,  -0.25, -0.55, 1.03,  0.14,  -0.18, -0.35, 1.01,  0.33,  -0.02, -0.33, 0.97,
    0.2,   -0.11, -0.43, 0.9,   -0.09, -0.37, -0.73, -0.37, -0.44, -0.44, 0.49,  0.92,  0.64};
constexpr double kWidths[kPairs] = {
    0.57, 0.36, 0.49, 0.6,  0.23, 0.21, 0.23, 0.4,  0.23, 0.12, 0.22, 0.32, 0.23,
    0.17, 0.16, 0.31, 0.19, 0.25, 0.24, 0.42, 0.31, 0.24, 0.24, 0.51, 0.16, 0.22};
// Half widths: one pair that is far off counts no more than this.
constexpr double kLargestDeviation = 5.0;
// A tracker's bones change by up to 18 % from sample to sample (MediaPipe); the distance between
// landmarks of two fingers changes by far more.
constexpr double kRigidSpread = 0.2;
// Standard deviations between the quartiles of a normal distribution.
constexpr double kQuartilesApart = 1.349;

// A finger trembles in squared lengths of its bones: 2e-4 is 3 um of 30 mm.
constexpr double kLeastTrembling = 2e-4;
// Of the usual trembling. Rounded to 1 mm, and at rest, bones keep 0.1 of it.
constexpr double kStuck = 0.01;
// A finger that the palm carries as it is [m]: over some seconds, rounding to float32 moves it by 1 um,
// and none of ours stays within 1 mm (Leap hands with rigid bones, 128 samples). A joint at its limit,
// most often straight, may rest; quantised sensors repeat in all fingers.
constexpr double kCarried = 5e-6, kStep = 2e-6;
// Of the steps between samples, in the middle finger by that share.
constexpr double kOthersChange = 0.8;
// Cosines of bends that are no limits: of 75 and 2 degrees.
constexpr double kMostBent = 0.25881904510252074, kLeastBent = 0.9993908270190958;

// Farthest that people's MCP and PIP joints bend backwards, as the mean sine of four fingers: 49 and 12
// degrees. MCPs reach 45 degrees by themselves (e-hand.com, normal range of motion).
constexpr double kHyperextension[2] = {0.75, 0.20};
// Sizes of the features of `palmar_evidence`, at which they are taken as certain.
constexpr double kFeatureSizes[5] = {0.10, 0.05, 0.20, kHyperextension[1], 0.10};

// Orders in which landmarks may come, our own first, and the pairs whose distances they need.
struct LandmarkOrders {
  std::vector<std::array<int, kLandmarks>> orders;
  // The 26 pairs of our own order, and then those that other orders need.
  std::vector<std::pair<int, int>> pairs;
  // Where the pairs of each order are: for each of the 26, those of all orders behind each other.
  std::vector<int> places;

  explicit LandmarkOrders(std::vector<std::array<int, kLandmarks>> known)
      : orders(std::move(known)) {
    std::map<std::pair<int, int>, int> numbers;
    const auto place_of = [&](int a, int b) {
      const auto [at, is_new] =
          numbers.try_emplace(std::minmax(a, b), static_cast<int>(pairs.size()));
      if (is_new) pairs.emplace_back(a, b);
      return at->second;
    };
    for (const auto& ends : kEnds) place_of(ends[0], ends[1]);
    for (const auto& ends : kEnds)
      for (const auto& order : orders) places.push_back(place_of(order[ends[0]], order[ends[1]]));
  }
};

// Of indices of our landmarks among those that came, in each order; our own order comes first.
inline std::shared_ptr<const LandmarkOrders> make_orders(const std::vector<Indices>& indices) {
  expect_that(!indices.empty(), "orders", "one at least");
  std::vector<std::array<int, kLandmarks>> known;
  for (const Indices& each : indices) {
    expect_count("orders: landmarks", each.size(), kLandmarks);
    expect_below("orders", each, kLandmarks);
    std::copy(each.begin(), each.end(), known.emplace_back().begin());
  }
  return std::make_shared<const LandmarkOrders>(std::move(known));
}

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

// Logarithms of the distances of pairs, the medians over some samples [log m], and how much they vary:
// interquartile ranges as standard deviations.
struct Distances {
  Vector medians, spreads;

  // Of the pairs [from, to).
  void measure(const std::pair<int, int>* pairs, int from, int to, const Landmarks* hands, int n) {
    const int width = to - from;
    squares.resize(static_cast<size_t>(n) * width);
    for (int t = 0; t < n; ++t)
      for (int k = 0; k < width; ++k) {
        const auto& [first, second] = pairs[from + k];
        const Vec3 apart = hands[t][first] - hands[t][second];
        squares[t * width + k] = dot(apart, apart);
      }
    sort_columns(squares.data(), n, width);
    const auto log_of = [&](int row, int k) {
      return 0.5 * std::log(std::max(squares[row * width + k], 1e-24));
    };
    medians.resize(to);
    spreads.resize(to);
    for (int k = 0; k < width; ++k) {
      medians[from + k] = log_of(n / 2, k);
      spreads[from + k] = (log_of(n - 1 - n / 4, k) - log_of(n / 4, k)) / kQuartilesApart;
    }
  }

  // The logarithm of the hand's size: the upper median over the pairs of our own order.
  double log_size() const {
    double deviations[kPairs];
    for (int i = 0; i < kPairs; ++i) deviations[i] = medians[i] - kCentres[i];
    return upper_median(deviations, kPairs);
  }

  // Length from the wrist to the tip of the middle finger along the bones [m].
  double hand_length() const {
    double length = 0.0;
    for (int i = 8; i < 12; ++i) length += std::exp(medians[i]);
    return length;
  }

  // Make room for so many pairs in so many samples.
  void reserve(size_t pairs, size_t samples) {
    for (Vector* each : {&medians, &spreads}) each->reserve(pairs);
    squares.reserve(pairs * samples);
  }

 private:
  Vector squares;  // of the distances, a row for each sample
};

// How badly landmarks fit a hand in each order: root mean square deviation from the proportions of
// hands [half widths of their range], and from rigidity. Below 1.3 for hands, above 1.5 for orders that
// are wrong in more than the exchange of two similar fingers.
struct Misfits {
  Vector of_orders;

  void measure(const Distances& distances, const LandmarkOrders& orders) {
    const size_t count = orders.orders.size();
    deviations.resize(kPairs * count);
    of_orders.assign(count, 0.0);
    for (size_t i = 0; i < kPairs; ++i)
      for (size_t k = 0; k < count; ++k)
        deviations[i * count + k] = distances.medians[orders.places[i * count + k]] - kCentres[i];
    sorted = deviations;
    sort_columns(sorted.data(), kPairs, static_cast<int>(count));
    const double* middles = sorted.data() + kPairs / 2 * count;
    for (size_t i = 0; i < kPairs; ++i)
      for (size_t k = 0; k < count; ++k) {
        const double off = (deviations[i * count + k] - middles[k]) / kWidths[i];
        const double soft = distances.spreads[orders.places[i * count + k]] / kRigidSpread;
        const double square = off * off + soft * soft;
        constexpr double kMost = kLargestDeviation * kLargestDeviation;
        // A square that is NaN stays one.
        of_orders[k] += square > kMost ? kMost : square;
      }
    for (double& sum : of_orders) sum = std::sqrt(sum / kPairs);
  }

  // Make room for so many orders.
  void reserve(size_t orders) {
    of_orders.reserve(orders);
    for (Vector* each : {&deviations, &sorted}) each->reserve(kPairs * orders);
  }

 private:
  Vector deviations, sorted;  // a column for each order
};

// The same in our own order. Noise makes bones look soft; without spreads, proportions alone count.
inline double misfit(const Distances& distances, bool has_spreads) {
  const double size = distances.log_size();
  double sum = 0.0;
  for (int i = 0; i < kPairs; ++i) {
    const double off = (distances.medians[i] - kCentres[i] - size) / kWidths[i];
    const double soft = has_spreads ? distances.spreads[i] / kRigidSpread : 0.0;
    const double square = off * off + soft * soft;
    constexpr double kMost = kLargestDeviation * kLargestDeviation;
    sum += square > kMost ? kMost : square;
  }
  return std::sqrt(sum / kPairs);
}

// How surely a hand is a right one; of a left hand, both are negative. About 0 for a flat hand of a
// tracker without an arched palm.
struct PalmarEvidence {
  // From the thumb's base, the arch of the knuckles, the thumb's MCP joint and the fingers, -5 to 5.
  double total;
  // From the bends of the fingers, -2 to 2. PIP joints count in full at the limit of people's
  // hyperextension, MCP joints from 0 there to full at 58 degrees.
  double fingers;
};

// On every hand, the thumb's base and the bent fingers lie on the palmar side of the plane through
// wrist, index and little MCP joints, and the middle and ring MCP joints on its dorsal side.
inline PalmarEvidence palmar_evidence(const Landmarks& hand) {
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
  // Up to people's hyperextension, an MCP joint may be bent to either side.
  const double limit = kHyperextension[0];
  const double features[5] = {height(1), -0.5 * (height(9) + height(13)), height(2), bends,
                              bent - clip(bent, -limit, limit)};
  double evidence[5];
  for (int i = 0; i < 5; ++i) evidence[i] = clip(features[i] / kFeatureSizes[i], -1.0, 1.0);
  const double fingers = evidence[3] + evidence[4];
  return {evidence[0] + evidence[1] + evidence[2] + fingers, fingers};
}

// The first finger that repeats to rounding while most others tremble; -1 if none does. A finger that
// is held still trembles too. Of a tracker with rigid bones nothing can be told.
inline int stuck_finger(const Landmarks* hands, int n) {
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
      const double change = (most - least) / (sum / n);
      // A bone without length gives NaN, which stays.
      if (!(change <= trembling[f])) trembling[f] = change;
      if (std::isnan(change)) break;
    }
    // Rounded landmarks of a hand at rest repeat in the tracker's world too.
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
    if (trembling[f] < kStuck * usual && is_carried[f] && usual > kLeastTrembling) return f;
  return -1;
}

constexpr int kSpans = 9;
// Distances of three joints of a finger to three landmarks of the palm.
inline double span(const Landmarks& hand, int finger, int i) {
  constexpr int kTo[3] = {0, 5, 17};
  return norm(hand[4 * finger + 2 + i / 3] - hand[kTo[i % 3]]);
}

// Whether a finger has a joint that is neither straight nor at its limit.
inline bool is_bent(const Landmarks& hand, int finger) {
  Vec3 bones[3];
  for (int k = 0; k < 3; ++k)
    bones[k] = unit(hand[4 * finger + 2 + k] - hand[4 * finger + 1 + k]);
  for (int k = 0; k < 2; ++k) {
    const double bend = dot(bones[k + 1], bones[k]);
    if (kMostBent <= bend && bend <= kLeastBent) return true;
  }
  return false;
}

// The first bent finger that the palm carries as it is while the other fingers move; -1 if none is.
// This finds them where bones are rigid, and takes some seconds.
inline int carried_finger(const Landmarks* const* hands, size_t count) {
  if (count == 0) return -1;
  int found = -1;
  for (int f = 0; f < kFingers && found < 0; ++f) {
    bool is_rigid = true;
    for (int i = 0; i < kSpans && is_rigid; ++i) {
      double least = HUGE_VAL, most = -HUGE_VAL;
      for (size_t t = 0; t < count; ++t) {
        const double away = span(*hands[t], f, i);
        least = std::min(least, away);
        most = std::max(most, away);
        if (!(is_rigid = most - least < kCarried)) break;
      }
    }
    if (is_rigid && is_bent(*hands[count - 1], f)) found = f;
  }
  if (found < 0) return -1;
  double changing[kFingers] = {};
  for (size_t t = 1; t < count; ++t)
    for (int f = 0; f < kFingers; ++f) {
      bool changes = false;
      for (int i = 0; i < kSpans && !changes; ++i)
        changes = std::abs(span(*hands[t], f, i) - span(*hands[t - 1], f, i)) > kStep;
      changing[f] += changes;
    }
  const double steps = static_cast<double>(count - 1);
  return upper_median(changing, kFingers) > kOthersChange * steps ? found : -1;
}

}  // namespace handmap
