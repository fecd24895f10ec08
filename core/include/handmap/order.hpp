// Order statistics of numbers among which NaN may be.
//
// NaN is neither smaller nor greater than a number, so it has no place in an order: where it meets one,
// `std::nth_element` and `std::sort` read behind the range.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace handmap {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// Put NaN behind all numbers; return how many numbers there are.
inline size_t put_numbers_first(double* values, size_t count) {
  const auto is_number = [](double value) { return !std::isnan(value); };
  return static_cast<size_t>(std::partition(values, values + count, is_number) - values);
}

// The value at a place of the sorted values, NaN behind all numbers as `np.sort` has it; NaN without
// values. Changes the order of `values`.
inline double nth_smallest(double* values, size_t count, size_t place) {
  const size_t numbers = put_numbers_first(values, count);
  if (place >= numbers) return kNaN;
  std::nth_element(values, values + place, values + numbers);
  return values[place];
}

// The upper median. Changes the order of `values`.
inline double upper_median(double* values, size_t count) {
  return nth_smallest(values, count, count / 2);
}

// The median as of `np.median`: NaN if a value is, or without values; an even count has the mean of the
// two in the middle. Changes the order of `values`.
inline double median(double* values, size_t count) {
  const size_t middle = count / 2;
  if (count == 0 || put_numbers_first(values, count) < count) return kNaN;
  const double upper = nth_smallest(values, count, middle);
  if (count % 2) return upper;
  const double lower = *std::max_element(values, values + middle);
  return (lower + upper) / 2.0;
}
inline double median(std::vector<double>& values) { return median(values.data(), values.size()); }

// A percentile as of `np.percentile`: NaN if a value is, or without values. Changes the order of
// `values`.
inline double percentile_of(std::vector<double>& values, double percentile) {
  const size_t count = values.size();
  if (count == 0 || put_numbers_first(values.data(), count) < count) return kNaN;
  const double place = 0.01 * percentile * static_cast<double>(count - 1);
  const size_t low = std::min(static_cast<size_t>(place), count - 1);
  const double value = nth_smallest(values.data(), count, low);
  if (low + 1 == count) return value;
  const double next = *std::min_element(values.begin() + low + 1, values.end());
  return value + (place - static_cast<double>(low)) * (next - value);
}

}  // namespace handmap
