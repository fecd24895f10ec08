// What the fingers of a hand are about to do in place of going to their targets; see detours.hpp.
#pragma once

#include "limits.hpp"

namespace handmap {

// Samples of a way that are foreseen, at most.
constexpr int kSamplesAhead = 6;

// A look ahead of a hand, a few QPs of it in each sample: what it foresees, and what it
// has found.
struct Foresight {
  // Postures that may be a detour, in the order in which they are tried: that to which the rest term
  // pulls, and straighter fingers.
  enum class Candidate { none, rest, straighter };
  // Ways that are foreseen: by the candidate, by nothing, and straight to where the first of them ended.
  enum class Way { by_candidate, by_itself, direct };

  Candidate candidate = Candidate::none;  // none where the hand does not look
  Way way = Way::by_candidate;
  Vector posture = {};   // the candidate's
  Vector via = {};       // what the way passes, if anything
  bool is_past = false;  // whether the hand that is foreseen has passed it
  int steps = 0;         // towards it, or since then
  double credit = 0.0;   // QPs that are granted, and not foreseen yet
  Motion motion = {};    // of the hand that is foreseen
  Vector ended = {};     // its errors [cost]
  bool has_ahead = false;         // whether the way by nothing has been foreseen
  Vector ahead = {};              // errors where that ended [cost]
  Vector found = {}, joints = {};  // errors and joints where the way by the candidate ended

  bool is_looking() const { return candidate != Candidate::none; }

  template <class Visit>
  void fields(Visit& visit) {
    visit(candidate);
    visit(way);
    visit(posture);
    visit(via);
    visit(is_past);
    visit(steps);
    visit(credit);
    visit(motion.q);
    visit(motion.displacement);
    visit(motion.dt);
    visit(motion.stop_times);
    visit(motion.time);
    visit(ended);
    visit(has_ahead);
    visit(ahead);
    visit(found);
    visit(joints);
  }
};

struct Detour {
  Vector via = {};               // posture that they pass; none in most samples
  std::vector<Vec3> points = {};  // targets for which it is sought, or was found
  Vector known = {};             // errors of the hand where it, or none, was found [cost]
  double left = 0.0;             // time left to find it, or to reach it [s]
  double wait = 0.0;             // time until it may look ahead again [s]
  Foresight foresight = {};

  template <class Visit>
  void fields(Visit& visit) {
    visit(via);
    visit(points);
    visit(known);
    visit(left);
    visit(wait);
    foresight.fields(visit);
  }

  // Make room for a search of this hand, of which so many errors are known.
  void reserve(const Tree& tree, size_t errors) {
    const size_t joints = tree.q_indices.size();
    for (Vector* each : {&via, &foresight.posture, &foresight.via, &foresight.joints})
      each->reserve(joints);
    for (Vector* each : {&known, &foresight.ended, &foresight.ahead, &foresight.found})
      each->reserve(errors);
    points.reserve(tree.points.size());
    foresight.motion.reserve(static_cast<size_t>(tree.nq), static_cast<size_t>(tree.size));
  }

  // Reject one of another hand.
  void expect_hand(const Tree& tree) const {
    const auto expect_list = [](const Vector& list, size_t count, bool may_lack) {
      expect_that(list.size() == count || (may_lack && list.empty()), "detours", "those of this hand");
    };
    const Foresight& look = foresight;
    const bool has_none = !look.is_looking();
    const size_t joints = tree.q_indices.size(), coordinates = tree.size;
    for (const Vector* each : {&via, &look.via, &look.joints}) expect_list(*each, joints, true);
    expect_list(look.posture, joints, has_none);
    for (const Vector* each : {&look.found, &look.ahead})
      expect_list(*each, look.ended.size(), true);
    expect_that(points.empty() || points.size() == tree.points.size(), "detours", "those of this hand");
    expect_list(look.motion.q, tree.nq, has_none);
    for (const Vector* each : {&look.motion.displacement, &look.motion.stop_times})
      expect_list(*each, coordinates, has_none);
    expect_that(look.motion.dt > 0.0, "detours", "a time above 0");
    expect_that(has_none || look.is_past || !look.via.empty(), "detours", "a posture to go by");
    expect_that(has_none || look.steps < kSamplesAhead, "detours", "steps of a look ahead");
  }
};

// Writes the fields of a detour as numbers, a list behind its length.
class DetourWriter {
 public:
  Vector numbers;

  template <class Number>
  void operator()(const Number& number) {
    numbers.push_back(static_cast<double>(number));
  }
  void operator()(const Vector& list) {
    numbers.push_back(static_cast<double>(list.size()));
    numbers.insert(numbers.end(), list.begin(), list.end());
  }
  void operator()(const std::vector<Vec3>& list) {
    numbers.push_back(static_cast<double>(list.size()));
    for (const Vec3& each : list) numbers.insert(numbers.end(), {each.x, each.y, each.z});
  }
};

// Reads them again. Lists that are longer than the numbers are wrong input.
class DetourReader {
 public:
  explicit DetourReader(Vector numbers) : numbers_(std::move(numbers)) {}

  template <class Number>
  void operator()(Number& number) {
    number = static_cast<Number>(next());
  }
  void operator()(int& number) { number = whole(std::numeric_limits<int>::max()); }
  void operator()(Foresight::Candidate& candidate) {
    candidate = static_cast<Foresight::Candidate>(whole(2));
  }
  void operator()(Foresight::Way& way) { way = static_cast<Foresight::Way>(whole(2)); }
  void operator()(Vector& list) {
    list.resize(whole(left()));
    for (double& each : list) each = next();
  }
  void operator()(std::vector<Vec3>& list) {
    list.resize(whole(left() / 3));
    for (Vec3& each : list) {
      each.x = next();
      each.y = next();
      each.z = next();
    }
  }
  size_t left() const { return numbers_.size() - at_; }

 private:
  double next() {
    expect_that(left() > 0 && std::isfinite(numbers_[at_]), "detours", "all numbers of a detour");
    return numbers_[at_++];
  }
  int whole(size_t most) {
    const double number = next();
    expect_that(number >= 0.0 && number <= static_cast<double>(most), "detours",
                "numbers of a detour");
    return static_cast<int>(number);
  }

  const Vector numbers_;
  size_t at_ = 0;
};

}  // namespace handmap
