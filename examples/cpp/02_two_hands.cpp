// Two hands follow a person's two hands, each in a thread of its own, and one of them is stopped.
//
//     handmap hands save allegro_left && handmap hands save allegro_right && handmap convert demo demo.csv
//     02_two_hands allegro_left.hand allegro_right.hand demo.csv
#include <cmath>
#include <cstdio>
#include <thread>

#include "samples.hpp"

namespace {

struct Outcome {
  size_t commands = 0, held = 0;
  double farthest = 0.0;  // of any joint in the last command [rad or m]
  std::string problem;
};

// Follow all samples; stop for good after `stop_at` of them.
void follow(handmap_follower* hand, const std::vector<Sample>& samples, size_t stop_at, Outcome& outcome) {
  try {
    handmap_command command;
    for (const Sample& sample : samples) {
      if (outcome.commands == stop_at) check(handmap_stop(hand, handmap_usual_dt(hand), &command));
      const handmap_sample given = to_library(sample);
      check(handmap_follow(hand, &given, &command));
      outcome.held += command.is_held != 0;
      ++outcome.commands;
    }
    outcome.farthest = 0.0;
    for (size_t j = 0; j < command.joints; ++j)
      outcome.farthest = std::fmax(outcome.farthest, std::fabs(command.q[j]));
  } catch (const std::exception& error) {
    outcome.problem = error.what();
  }
}

void run(char** arguments) {
  const Hand hands[2] = {load_hand(arguments[1]), load_hand(arguments[2])};
  Outcome outcomes[2];
  std::thread threads[2];
  std::vector<Sample> samples[2];
  for (int i = 0; i < 2; ++i) {
    samples[i] = read_samples(arguments[3], handmap_side(hands[i].get()));
    // The first hand is stopped halfway.
    const size_t stop_at = i == 0 ? samples[i].size() / 2 : samples[i].size();
    threads[i] = std::thread(follow, hands[i].get(), std::cref(samples[i]), stop_at, std::ref(outcomes[i]));
  }
  for (std::thread& thread : threads) thread.join();
  for (int i = 0; i < 2; ++i) {
    if (!outcomes[i].problem.empty()) throw std::runtime_error(outcomes[i].problem);
    std::printf("%s: %zu commands, %zu of them held, largest joint position %.3f\n",
                handmap_name(hands[i].get()), outcomes[i].commands, outcomes[i].held,
                outcomes[i].farthest);
  }
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 4) {
    std::fprintf(stderr, "usage: 02_two_hands LEFT.hand RIGHT.hand SAMPLES.csv\n");
    return 2;
  }
  try {
    run(arguments);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "02_two_hands: %s\n", error.what());
    return 1;
  }
}
