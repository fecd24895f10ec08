// Counts the blocks of memory that a thread takes from the heap: preload it, and call `blocks_taken`. Only
// for glibc, under whose names the functions of its own are reached.
#include <cstddef>

extern "C" {
void* __libc_malloc(size_t size);
void* __libc_calloc(size_t count, size_t size);
void* __libc_realloc(void* block, size_t size);

static thread_local long taken __attribute__((tls_model("initial-exec"))) = 0;

void* malloc(size_t size) {
  ++taken;
  return __libc_malloc(size);
}
void* calloc(size_t count, size_t size) {
  ++taken;
  return __libc_calloc(count, size);
}
void* realloc(void* block, size_t size) {
  ++taken;
  return __libc_realloc(block, size);
}
long blocks_taken() { return taken; }
}
