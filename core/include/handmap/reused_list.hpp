// A list whose elements keep their memory.
#pragma once

#include <cstddef>
#include <vector>

namespace handmap {

// A list of elements that own memory, such as vectors. Elements that are dropped stay behind the end, and
// `add` and assignment take them again, so that a list that each sample fills alike allocates nothing.
template <class T>
class ReusedList {
 public:
  ReusedList() = default;
  ReusedList(const ReusedList& other) { *this = other; }
  ReusedList& operator=(const ReusedList& other) {
    if (elements_.size() < other.count_) elements_.resize(other.count_);
    for (std::size_t i = 0; i < other.count_; ++i) elements_[i] = other.elements_[i];
    count_ = other.count_;
    return *this;
  }

  // Append an element, which may have the values of one that was dropped: set all of them.
  T& add() {
    if (count_ == elements_.size()) elements_.emplace_back();
    return elements_[count_++];
  }
  void clear() { count_ = 0; }
  // Drop all elements but the first ones.
  void shorten(std::size_t count) {
    if (count < count_) count_ = count;
  }

  std::size_t size() const { return count_; }
  bool empty() const { return count_ == 0; }
  T& operator[](std::size_t i) { return elements_[i]; }
  const T& operator[](std::size_t i) const { return elements_[i]; }
  const T* begin() const { return elements_.data(); }
  const T* end() const { return elements_.data() + count_; }

 private:
  std::vector<T> elements_;
  std::size_t count_ = 0;
};

}  // namespace handmap
