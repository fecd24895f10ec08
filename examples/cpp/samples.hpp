// What the examples need besides the library: a file's bytes, a hand that frees itself, and the samples
// of a recording as `handmap convert take.npz take.csv` writes them.
#pragma once

#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "handmap/handmap.h"

struct Sample {
  std::string side;
  double time = 0.0;
  std::array<double, 63> landmarks{};
  bool valid = true;
  double confidence = 1.0;
  bool has_wrist = false;
  std::array<double, 16> wrist{};
};

inline std::string read_file(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + ": cannot be read");
  std::ostringstream content;
  content << file.rdbuf();
  return content.str();
}

// A function's result as an exception, which a program of C++ is used to.
inline void check(handmap_result result) {
  if (result != HANDMAP_OK) throw std::runtime_error(handmap_last_error());
}

struct FreeHand {
  void operator()(handmap_follower* hand) const { handmap_free(hand); }
};
using Hand = std::unique_ptr<handmap_follower, FreeHand>;

inline Hand load_hand(const std::string& path) {
  const std::string bytes = read_file(path);
  handmap_follower* hand = nullptr;
  if (handmap_load(bytes.data(), bytes.size(), nullptr, &hand) != HANDMAP_OK)
    throw std::runtime_error(path + ": " + handmap_last_error());
  return Hand(hand);
}

inline std::vector<std::string> split(const std::string& line) {
  std::vector<std::string> fields;
  std::string field;
  std::istringstream from(line);
  while (std::getline(from, field, ',')) fields.push_back(field);
  if (!line.empty() && line.back() == ',') fields.emplace_back();
  return fields;
}

// An empty field is a number that is not known.
inline double number_of(const std::string& field) {
  return field.empty() ? std::nan("") : std::strtod(field.c_str(), nullptr);
}

// The samples of one side, in their order.
inline std::vector<Sample> read_samples(const std::string& path, const std::string& side) {
  std::ifstream file(path);
  std::string line;
  if (!std::getline(file, line)) throw std::runtime_error(path + ": no samples");
  std::map<std::string, size_t> column;
  size_t first = 0;
  const std::vector<std::string> names = split(line);
  for (size_t i = 0; i < names.size(); ++i) column[names[i]] = i;
  if (!column.count("side") || !column.count("time") || !column.count("wrist_x"))
    throw std::runtime_error(path + ": expected a CSV of `handmap convert`");
  first = column["wrist_x"];
  std::vector<Sample> samples;
  while (std::getline(file, line)) {
    const std::vector<std::string> fields = split(line);
    if (fields.size() != names.size()) throw std::runtime_error(path + ": a line of another length");
    if (fields[column["side"]] != side) continue;
    Sample sample;
    sample.side = side;
    sample.time = number_of(fields[column["time"]]);
    for (size_t i = 0; i < sample.landmarks.size(); ++i)
      sample.landmarks[i] = number_of(fields[first + i]);
    if (column.count("valid")) sample.valid = number_of(fields[column["valid"]]) != 0.0;
    if (column.count("confidence")) sample.confidence = number_of(fields[column["confidence"]]);
    if (column.count("wrist_pose_00")) {
      // The last row of a pose is not in the file.
      sample.wrist[15] = 1.0;
      for (size_t i = 0; i < 12; ++i)
        sample.wrist[i] = number_of(fields[column["wrist_pose_00"] + i]);
      sample.has_wrist = !std::isnan(sample.wrist[0]);
    }
    samples.push_back(sample);
  }
  if (samples.empty()) throw std::runtime_error(path + ": no samples of a " + side + " hand");
  return samples;
}

// The sample for the library, whose arrays stay where they are.
inline handmap_sample to_library(const Sample& sample) {
  handmap_sample given = handmap_new_sample(sample.time, sample.landmarks.data());
  if (sample.has_wrist) given.wrist = sample.wrist.data();
  given.valid = sample.valid;
  given.confidence = sample.confidence;
  return given;
}
