// Objects on which one thread works at a time.
//
// Where the core releases the interpreter's lock, or calls Python, other threads come in. They could
// reach the same solver, guard or filter, and write into memory that is in use. So a thread marks an
// object before it works on it, and another one that comes in gets an error.
#pragma once

#include <exception>
#include <thread>
#include <utility>

namespace handmap {

// Thrown where a thread enters an object on which another one works, or the same one from a call of
// Python inside that. Python has it as `errors.MapperBusyError`.
struct BusyError : std::exception {
  const char* what() const noexcept override { return "at work in another thread"; }
};

// Base of objects on which one thread works at a time. Threads hold the interpreter's lock when they
// read or write the mark.
class Exclusive {
 private:
  friend class Work;
  friend class Reading;
  bool is_at_work_ = false;
  std::thread::id owner_;
};

// Work on an object, from here to the end of the block; throws BusyError if somebody works on it.
class Work {
 public:
  explicit Work(Exclusive& object) : object_(object) {
    if (object.is_at_work_) throw BusyError();
    object.is_at_work_ = true;
    object.owner_ = std::this_thread::get_id();
  }
  Work(const Work&) = delete;
  ~Work() { object_.is_at_work_ = false; }

 private:
  Exclusive& object_;
};

// Read from an object; throws BusyError if another thread works on it. The same thread may read what it
// works on, such as a task of Python whose rows depend on the motion.
class Reading {
 public:
  explicit Reading(const Exclusive& object) {
    if (object.is_at_work_ && object.owner_ != std::this_thread::get_id()) throw BusyError();
  }
};

// A function that reads an object, for Python.
template <class Owner, class Result, class... Arguments>
auto reading(Result (*function)(Owner&, Arguments...)) {
  return [function](Owner& owner, Arguments... arguments) -> Result {
    const Reading from(owner);
    return function(owner, std::forward<Arguments>(arguments)...);
  };
}

// A method, or a function of an object, for Python, in which one thread works on the object at a time.
template <class Owner, class Result, class... Arguments>
auto exclusively(Result (Owner::*method)(Arguments...)) {
  return [method](Owner& owner, Arguments... arguments) -> Result {
    const Work work(owner);
    return (owner.*method)(std::forward<Arguments>(arguments)...);
  };
}
template <class Owner, class Result, class... Arguments>
auto exclusively(Result (Owner::*method)(Arguments...) const) {
  return [method](Owner& owner, Arguments... arguments) -> Result {
    const Work work(owner);
    return (owner.*method)(std::forward<Arguments>(arguments)...);
  };
}
template <class Owner, class Result, class... Arguments>
auto exclusively(Result (*function)(Owner&, Arguments...)) {
  return [function](Owner& owner, Arguments... arguments) -> Result {
    const Work work(owner);
    return function(owner, std::forward<Arguments>(arguments)...);
  };
}

}  // namespace handmap
