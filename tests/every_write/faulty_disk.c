// Fails the k-th change of a folder. Preloaded, it counts every call that creates, writes, flushes, renames or removes
// something below `root`, by whatever language, and at call `at` it does what `kind` says. Calls of all threads count, and those
// of programs that the armed process starts: FAULTS_FILE holds the count that they share, FAULTS_ARM is KIND:ERRNO:AT:FOLDER.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { NONE, KILL, FAIL_ONCE, FAIL_FROM_HERE, SHORT };

// Shared with the process that forks the armed one, which reads the count after a kill, and with programs it starts.
static struct { long calls; int happened; } *shared;
static char root[PATH_MAX];
static size_t root_length;
static int kind, failure;
static long at;

static void arm(const char* folder, int what, int error, long call) {
  snprintf(root, sizeof root, "%s/", folder);
  root_length = strlen(root);
  kind = what, failure = error, at = call;
}
void faults_arm(const char* folder, int what, int error, long call) {
  arm(folder, what, error, call);
  shared->calls = 0, shared->happened = 0;
}
long faults_calls(void) { return shared->calls; }
int faults_happened(void) { return shared->happened; }

// True for an absolute path below the root, or a relative one below a descriptor of such a folder.
static int below(int folder, const char* path) {
  char base[PATH_MAX + 1], link[40];
  if (!root_length || !path) return 0;
  if (path[0] == '/') return strncmp(path, root, root_length) == 0;
  snprintf(link, sizeof link, folder == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", folder);
  ssize_t length = readlink(link, base, PATH_MAX - 1);
  if (length < 0) return 0;
  base[length] = '/', base[length + 1] = 0;
  return strncmp(base, root, root_length) == 0;
}
static int open_below(int file) {
  char path[PATH_MAX], link[40];
  if (!root_length) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, PATH_MAX - 1);
  return length > 0 && (path[length] = 0, strncmp(path, root, root_length) == 0);
}

static void die(void) { kill(getpid(), SIGKILL); for (;;) pause(); }

// Counts a call; true when it must fail, with errno set. Does not return from the call that kills. From a full disk on, only
// calls that need space fail.
static int counted(int needs_space) {
  long call = __atomic_add_fetch(&shared->calls, 1, __ATOMIC_SEQ_CST);
  int here = kind == FAIL_FROM_HERE ? at > 0 && call >= at && needs_space : call == at;
  if (!here) return 0;
  shared->happened = 1;
  if (kind == KILL) die();
  errno = failure;
  return kind == FAIL_ONCE || kind == FAIL_FROM_HERE;
}

#define REAL(name) static __typeof__(name)* real; if (!real) real = (__typeof__(name)*)dlsym(RTLD_NEXT, #name)
#define PATH_CALL(name, parameters, arguments, folder, path, space) \
  int name parameters { REAL(name); return below(folder, path) && counted(space) ? -1 : real arguments; }
#define FILE_CALL(name, parameters, arguments) \
  int name parameters { REAL(name); return open_below(file) && counted(1) ? -1 : real arguments; }

PATH_CALL(rename, (const char* from, const char* to), (from, to), AT_FDCWD, to, 0)
PATH_CALL(renameat, (int a, const char* from, int b, const char* to), (a, from, b, to), b, to, 0)
PATH_CALL(renameat2, (int a, const char* from, int b, const char* to, unsigned flags), (a, from, b, to, flags), b, to, 0)
PATH_CALL(link, (const char* from, const char* to), (from, to), AT_FDCWD, to, 0)
PATH_CALL(unlink, (const char* path), (path), AT_FDCWD, path, 0)
PATH_CALL(unlinkat, (int folder, const char* path, int flags), (folder, path, flags), folder, path, 0)
PATH_CALL(rmdir, (const char* path), (path), AT_FDCWD, path, 0)
PATH_CALL(mkdir, (const char* path, mode_t mode), (path, mode), AT_FDCWD, path, 1)
PATH_CALL(mkdirat, (int folder, const char* path, mode_t mode), (folder, path, mode), folder, path, 1)
PATH_CALL(chmod, (const char* path, mode_t mode), (path, mode), AT_FDCWD, path, 0)
FILE_CALL(ftruncate, (int file, off_t size), (file, size))
FILE_CALL(fsync, (int file), (file))
FILE_CALL(fdatasync, (int file), (file))

#define OPEN(name, first, second, folder)                                       \
  int name(first second const char* path, int flags, ...) {                     \
    REAL(name);                                                                 \
    va_list rest;                                                               \
    va_start(rest, flags);                                                      \
    mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;     \
    va_end(rest);                                                               \
    int writes = (flags & O_ACCMODE) != O_RDONLY;                               \
    return writes && below(folder, path) && counted((flags & O_CREAT) != 0) ? -1 : OPENED;            \
  }
#define OPENED real(path, flags, mode)
OPEN(open, , , AT_FDCWD)
OPEN(open64, , , AT_FDCWD)
#undef OPENED
#define OPENED real(folder, path, flags, mode)
#define COMMA ,
OPEN(openat, int folder, COMMA, folder)
OPEN(openat64, int folder, COMMA, folder)

// Writes half of it where a kill or a short write is due, so that torn files occur too.
static size_t allowed(int file, size_t size, int* fails) {
  if (!open_below(file)) return size;
  int due = shared->calls + 1 == at;
  if (due && kind == KILL && size > 1) { shared->happened = 1, shared->calls++; return size / 2; }
  *fails = counted(1);
  return due && kind == SHORT && size > 1 ? size / 2 : size;
}
#define WRITE(name, parameters, arguments)              \
  ssize_t name parameters {                             \
    REAL(name);                                         \
    int fails = 0;                                      \
    size_t asked = size;                                \
    size = allowed(file, size, &fails);                 \
    if (fails) return -1;                               \
    ssize_t written = real arguments;                   \
    if (size < asked && kind == KILL) die();            \
    return written;                                     \
  }
WRITE(write, (int file, const void* data, size_t size), (file, data, size))
WRITE(pwrite, (int file, const void* data, size_t size, off_t where), (file, data, size, where))
WRITE(pwrite64, (int file, const void* data, size_t size, off64_t where), (file, data, size, where))
FILE_CALL(ftruncate64, (int file, off64_t size), (file, size))
ssize_t writev(int file, const struct iovec* parts, int count) {
  REAL(writev);
  return open_below(file) && counted(1) ? -1 : real(file, parts, count);
}
ssize_t sendfile(int to, int from, off_t* offset, size_t size) {
  static ssize_t (*real)(int, int, off_t*, size_t);
  if (!real) real = (ssize_t (*)(int, int, off_t*, size_t))dlsym(RTLD_NEXT, "sendfile");
  return open_below(to) && counted(1) ? -1 : real(to, from, offset, size);
}
ssize_t copy_file_range(int from, off64_t* a, int to, off64_t* b, size_t size, unsigned flags) {
  REAL(copy_file_range);
  return open_below(to) && counted(1) ? -1 : real(from, a, to, b, size, flags);
}

__attribute__((constructor)) static void share(void) {
  const char *path = getenv("FAULTS_FILE"), *armed = getenv("FAULTS_ARM");
  int file = path ? open(path, O_RDWR) : -1, what, error, length = 0;
  long call;
  if (file < 0) abort();
  shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  if (armed && sscanf(armed, "%d:%d:%ld:%n", &what, &error, &call, &length) == 3) arm(armed + length, what, error, call);
}
