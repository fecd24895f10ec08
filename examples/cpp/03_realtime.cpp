// A loop at 1 kHz with the priority of a control loop, and a histogram of how long its samples take.
//
//     sudo 03_realtime allegro_right.hand demo.csv 60
//
// The samples of the file come again and again, resampled to 1 kHz. Without the right to a real-time
// priority (root, or `ulimit -r`), the loop says so and goes on.
#include <pthread.h>
#include <sched.h>
#include <sys/mman.h>
#include <time.h>

#include <algorithm>
#include <cstdio>

#include "samples.hpp"

namespace {

constexpr long kPeriod = 1000000;  // [ns]

double seconds(const timespec& at) {
  return static_cast<double>(at.tv_sec) + 1e-9 * static_cast<double>(at.tv_nsec);
}

timespec now() {
  timespec at;
  clock_gettime(CLOCK_MONOTONIC, &at);
  return at;
}

void add_period(timespec& at) {
  at.tv_nsec += kPeriod;
  if (at.tv_nsec < 1000000000) return;
  at.tv_nsec -= 1000000000;
  ++at.tv_sec;
}

// Whether this thread runs before all usual ones, and its memory stays where it is.
bool take_priority() {
  sched_param priority{};
  priority.sched_priority = 80;
  const bool is_first = pthread_setschedparam(pthread_self(), SCHED_FIFO, &priority) == 0;
  return mlockall(MCL_CURRENT | MCL_FUTURE) == 0 && is_first;
}

// Goes through a recording to its end, then back to its start, so that the hand never jumps.
class Player {
 public:
  explicit Player(std::vector<Sample> samples) : samples_(std::move(samples)) {
    samples_.erase(std::remove_if(samples_.begin(), samples_.end(),
                                  [](const Sample& sample) { return !sample.valid; }),
                   samples_.end());
    if (samples_.size() < 2) throw std::runtime_error("expected two valid samples or more");
    length_ = samples_.back().time - samples_.front().time;
  }

  // Write the landmarks at a time since the start [s].
  void write(double time, std::array<double, 63>& landmarks) const {
    double within = std::fmod(time, 2.0 * length_);
    if (within > length_) within = 2.0 * length_ - within;
    const double at = samples_.front().time + within;
    const auto later = [](double time, const Sample& sample) { return time < sample.time; };
    size_t next = static_cast<size_t>(
        std::upper_bound(samples_.begin(), samples_.end(), at, later) - samples_.begin());
    next = std::min(std::max<size_t>(next, 1), samples_.size() - 1);
    const Sample &a = samples_[next - 1], &b = samples_[next];
    const double share = (at - a.time) / (b.time - a.time);
    for (size_t i = 0; i < landmarks.size(); ++i)
      landmarks[i] = a.landmarks[i] + share * (b.landmarks[i] - a.landmarks[i]);
  }

 private:
  std::vector<Sample> samples_;
  double length_ = 0.0;
};

// Counts of times by powers of two [us].
class Histogram {
 public:
  void add(double microseconds) {
    size_t bin = 0;
    while (bin + 1 < kBins && microseconds >= limit(bin)) ++bin;
    ++counts_[bin];
    most_ = std::max(most_, microseconds);
  }
  double most() const { return most_; }
  void print() const {
    for (size_t bin = 0; bin < kBins; ++bin)
      if (counts_[bin] > 0) std::printf("  below %6.0f us  %8zu\n", limit(bin), counts_[bin]);
  }

 private:
  static constexpr size_t kBins = 14;
  static double limit(size_t bin) { return 8.0 * static_cast<double>(1u << bin); }
  size_t counts_[kBins] = {};
  double most_ = 0.0;
};

void run(const std::string& hand_file, const std::string& samples_file, double duration) {
  const Hand hand = load_hand(hand_file);
  const Player player(read_samples(samples_file, handmap_side(hand.get())));
  if (!take_priority())
    std::printf("no real-time priority: other programs may delay this loop\n");
  Histogram taken;
  size_t missed = 0, count = 0;
  std::array<double, 63> landmarks{};
  timespec next = now();
  const double start = seconds(next);
  while (seconds(next) - start < duration) {
    const timespec began = now();
    player.write(seconds(next) - start, landmarks);
    const handmap_sample sample = handmap_new_sample(seconds(next), landmarks.data());
    handmap_command command;
    check(handmap_follow(hand.get(), &sample, &command));
    const timespec ended = now();
    taken.add(1e6 * (seconds(ended) - seconds(began)));
    ++count;
    add_period(next);
    // A command that is not ready when the next sample is due has come too late.
    missed += seconds(ended) > seconds(next);
    while (seconds(now()) > seconds(next)) add_period(next);
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, nullptr);
  }
  std::printf("%s: %zu samples at 1 kHz, %zu missed, the longest took %.0f us\n",
              handmap_name(hand.get()), count, missed, taken.most());
  taken.print();
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 4) {
    std::fprintf(stderr, "usage: 03_realtime FILE.hand SAMPLES.csv SECONDS\n");
    return 2;
  }
  try {
    run(arguments[1], arguments[2], std::strtod(arguments[3], nullptr));
  } catch (const std::exception& error) {
    std::fprintf(stderr, "03_realtime: %s\n", error.what());
    return 1;
  }
}
