// Follow the samples that a parent process requests by the library in C, and time each one:
// `interleaved.Worker`, as follower_worker.py does in Python.
//
//     library_worker FILE.hand SAMPLES.csv
//
// Requests and answers are lines of JSON. A request names a range of samples, and whether to start
// again. An answer holds the thread's CPU time of each call less the timer's [ns], and the robot's
// joints and wrist after it.
#include <time.h>

#include <cinttypes>
#include <cstdint>
#include <cstdio>
#include <cstring>

#include "samples.hpp"

namespace {

int64_t cpu_time() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return int64_t{1000000000} * now.tv_sec + now.tv_nsec;
}

// The least time between two readings of the clock [ns].
int64_t timer_cost() {
  int64_t least = INT64_MAX;
  for (int i = 0; i < 2000; ++i) {
    const int64_t started = cpu_time();
    const int64_t cost = cpu_time() - started;
    if (cost < least) least = cost;
  }
  return least;
}

void print_list(const double* numbers, size_t count) {
  for (size_t i = 0; i < count; ++i) std::printf("%s%.17g", i ? ", " : "[", numbers[i]);
  std::printf("]");
}

void answer(handmap_follower* hand, const std::vector<Sample>& samples, size_t first, size_t last,
            int64_t timer) {
  std::vector<std::vector<double>> joints, wrists;
  std::printf("{\"ns\": [");
  for (size_t i = first; i < last; ++i) {
    const handmap_sample sample = to_library(samples.at(i));
    handmap_command command;
    const int64_t started = cpu_time();
    const handmap_result result = handmap_follow(hand, &sample, &command);
    const int64_t taken = cpu_time() - started - timer;
    check(result);
    std::printf("%s%" PRId64, i > first ? ", " : "", taken);
    joints.emplace_back(command.q, command.q + command.joints);
    wrists.emplace_back(command.wrist, command.wrist + 16);
  }
  for (const auto* lists : {&joints, &wrists}) {
    std::printf(lists == &joints ? "], \"q\": [" : "], \"wrist\": [");
    for (size_t i = 0; i < lists->size(); ++i) {
      if (i) std::printf(", ");
      print_list((*lists)[i].data(), (*lists)[i].size());
    }
  }
  std::printf("]}\n");
  std::fflush(stdout);
}

void serve(const char* hand_file, const char* samples_file) {
  Hand hand = load_hand(hand_file);
  const std::vector<Sample> samples = read_samples(samples_file, handmap_side(hand.get()));
  const int64_t timer = timer_cost();
  std::printf("{\"ready\": true, \"samples\": %zu}\n", samples.size());
  std::fflush(stdout);
  char line[256];
  while (std::fgets(line, sizeof line, stdin)) {
    size_t first = 0, last = 0;
    if (std::sscanf(line, "{\"samples\": [%zu, %zu]", &first, &last) != 2)
      throw std::runtime_error("a request of another form");
    if (std::strstr(line, "\"starts\": true")) hand = load_hand(hand_file);
    answer(hand.get(), samples, first, last, timer);
  }
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 3) {
    std::fprintf(stderr, "usage: library_worker FILE.hand SAMPLES.csv\n");
    return 2;
  }
  try {
    serve(arguments[1], arguments[2]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "library_worker: %s\n", error.what());
    return 1;
  }
}
