// Counts what warm samples of the library ask of the system: blocks of memory, locks and system calls.
//
//     warm_samples FILE.hand SAMPLES.csv WARM_UP [block|lock|call]
//
// The first samples, WARM_UP of them, are not counted. The last argument puts one of these things into a
// sample, so that a test sees that it is counted. Prints how many samples were counted, how many of them
// were held, and blocks, locks and the end of a process that is killed at its first system call: "exit 0",
// "signal 31" (SIGSYS), or "exit 77" where the kernel has no seccomp.
//
// Only for glibc on Linux, under whose names the functions of its own are reached.
#include <dlfcn.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <pthread.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstddef>
#include <cstdio>
#include <vector>

#include "samples.hpp"

extern "C" {
void* __libc_malloc(size_t size);
void* __libc_calloc(size_t count, size_t size);
void* __libc_realloc(void* block, size_t size);
void __libc_free(void* block);
}

namespace {

// Of this process, since its start. Memory that is given back counts as well: `free` may lock.
long blocks = 0, locks = 0;

using Lock = int (*)(pthread_mutex_t*);
Lock real_lock() {
  static const Lock found = reinterpret_cast<Lock>(dlsym(RTLD_NEXT, "pthread_mutex_lock"));
  return found;
}

}  // namespace

extern "C" {
void* malloc(size_t size) {
  ++blocks;
  return __libc_malloc(size);
}
void* calloc(size_t count, size_t size) {
  ++blocks;
  return __libc_calloc(count, size);
}
void* realloc(void* block, size_t size) {
  ++blocks;
  return __libc_realloc(block, size);
}
void free(void* block) {
  blocks += block != nullptr;
  __libc_free(block);
}
int pthread_mutex_lock(pthread_mutex_t* mutex) {
  ++locks;
  return real_lock()(mutex);
}
}

namespace {

constexpr double kDt = 1.0 / 60.0;

// Ask the system for what a test has to notice.
void spoil(const std::string& by) {
  if (by == "block") {
    void* volatile block = malloc(1);
    free(block);
  } else if (by == "lock") {
    pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
    pthread_mutex_lock(&mutex);
    pthread_mutex_unlock(&mutex);
  } else if (by == "call") {
    syscall(SYS_getppid);
  }
}

// All calls of a control loop, one after the other.
class Loop {
 public:
  Loop(const std::string& hand_file, const std::string& samples_file, std::string spoilt_by)
      : hand_(load_hand(hand_file)), spoilt_by_(std::move(spoilt_by)) {
    for (const Sample& sample : read_samples(samples_file, handmap_side(hand_.get())))
      samples_.push_back(sample);
  }

  size_t size() const { return samples_.size(); }
  size_t held() const { return held_; }

  // Follow samples; return whether the library took all of them.
  bool follow(size_t first, size_t last) {
    bool is_right = true;
    for (size_t i = first; i < last; ++i) {
      const handmap_sample sample = to_library(samples_[i]);
      is_right &= handmap_follow(hand_.get(), &sample, &command_) == HANDMAP_OK;
      held_ += command_.is_held;
      if (i + 1 == size()) spoil(spoilt_by_);
    }
    return is_right;
  }

  // Map landmarks, hold, and stop.
  bool end() {
    const double* landmarks = samples_.back().landmarks.data();
    bool is_right = true;
    for (int i = 0; i < 10; ++i)
      is_right &= handmap_map_landmarks(hand_.get(), landmarks, nullptr, kDt, &command_) == HANDMAP_OK;
    for (int i = 0; i < 10; ++i)
      is_right &= handmap_hold(hand_.get(), kDt, &command_) == HANDMAP_OK;
    return is_right && handmap_stop(hand_.get(), kDt, &command_) == HANDMAP_OK;
  }

 private:
  const Hand hand_;
  const std::string spoilt_by_;
  std::vector<Sample> samples_;
  handmap_command command_{};
  size_t held_ = 0;
};

// Kill this process at any further system call but the end of its thread.
bool forbid_system_calls() {
  sock_filter steps[] = {
      BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, nr)),
      BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_exit, 0, 1),
      BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
      BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
  };
  const sock_fprog program{sizeof(steps) / sizeof(steps[0]), steps};
  return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 &&
         prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program) == 0;
}

// Go on with a warm loop in a process without system calls; return how that ended.
int status_without_calls(Loop& loop, size_t from) {
  const pid_t child = fork();
  if (child < 0) throw std::runtime_error("no further process");
  if (child == 0) {
    if (!forbid_system_calls()) _exit(77);
    const bool is_right = loop.follow(from, loop.size()) && loop.end();
    syscall(SYS_exit, is_right ? 0 : 1);
  }
  int status = 0;
  waitpid(child, &status, 0);
  return status;
}

int run(const std::string& hand_file, const std::string& samples_file, size_t warm_up,
        const std::string& spoilt_by) {
  real_lock();
  Loop loop(hand_file, samples_file, spoilt_by);
  if (loop.size() <= warm_up) throw std::runtime_error("expected more samples");
  bool is_right = loop.follow(0, warm_up);
  const int status = status_without_calls(loop, warm_up);
  const size_t held = loop.held();
  const long blocks_before = blocks, locks_before = locks;
  is_right &= loop.follow(warm_up, loop.size()) && loop.end();
  const long taken = blocks - blocks_before, locked = locks - locks_before;
  const char* how = WIFSIGNALED(status) ? "signal" : "exit";
  const int number = WIFSIGNALED(status) ? WTERMSIG(status) : WEXITSTATUS(status);
  std::printf("samples %zu held %zu blocks %ld locks %ld %s %d\n", loop.size() - warm_up,
              loop.held() - held, taken, locked, how, number);
  return is_right ? 0 : 1;
}

}  // namespace

int main(int count, char** arguments) {
  if (count < 4 || count > 5) return 2;
  try {
    return run(arguments[1], arguments[2], std::strtoul(arguments[3], nullptr, 10),
               count == 5 ? arguments[4] : "");
  } catch (const std::exception& error) {
    std::fprintf(stderr, "warm_samples: %s\n", error.what());
    return 1;
  }
}
