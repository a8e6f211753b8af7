/* Preloaded into a process: counts its operations on files below a folder. At the n-th operation it
   makes the disk full or sends a signal to the process.

   fhash_faults(folder, n, code): code > 0 is the errno with which the n-th operation and all later
   ones that take space fail; code < 0 is minus the signal that the process sends itself before the
   n-th operation; n = 0 only counts. fhash_fault_count() is the number of operations so far.
   Reading and closing are no operations, since they need no space. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static char folder[PATH_MAX];
static size_t length;
static long at, count;
static int code;

void fhash_faults(const char *path, long n, int what) {
    strncpy(folder, path, sizeof folder - 1);
    length = strlen(folder);
    at = n, code = what, count = 0;
}

long fhash_fault_count(void) { return __atomic_load_n(&count, __ATOMIC_SEQ_CST); }

static int below(const char *path) {
    return length && strncmp(path, folder, length) == 0 && path[length] == '/';
}

static int below_fd(int fd) {
    char link[64], path[PATH_MAX];
    if (!length) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return below(path);
}

/* Counts an operation and sends the signal, if any; returns 1 if the operation must fail. */
static int fault(int ours) {
    if (!ours) return 0;
    long now = __atomic_add_fetch(&count, 1, __ATOMIC_SEQ_CST);
    if (!at || now < at) return 0;
    if (code < 0) {
        if (now == at) kill(getpid(), -code);
        return 0;
    }
    errno = code;
    return 1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *data, size_t size) {
    return fault(below_fd(fd)) ? -1 : REAL(write)(fd, data, size);
}
ssize_t writev(int fd, const struct iovec *parts, int n) {
    return fault(below_fd(fd)) ? -1 : REAL(writev)(fd, parts, n);
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t to) {
    return fault(below_fd(fd)) ? -1 : REAL(pwrite)(fd, data, size, to);
}
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t to) {
    return fault(below_fd(fd)) ? -1 : REAL(pwrite64)(fd, data, size, to);
}
int ftruncate(int fd, off_t size) { return fault(below_fd(fd)) ? -1 : REAL(ftruncate)(fd, size); }
int ftruncate64(int fd, off64_t size) {
    return fault(below_fd(fd)) ? -1 : REAL(ftruncate64)(fd, size);
}
int fsync(int fd) { return fault(below_fd(fd)) ? -1 : REAL(fsync)(fd); }
int link(const char *from, const char *to) { return fault(below(to)) ? -1 : REAL(link)(from, to); }
int mkdir(const char *path, mode_t mode) {
    return fault(below(path)) ? -1 : REAL(mkdir)(path, mode);
}

/* A rename takes no space, so it does not fail on a full disk. It is a moment for a signal. */
int rename(const char *from, const char *to) {
    if (code < 0 || !at) fault(below(to));
    return REAL(rename)(from, to);
}

#define OPENING(name)                                                        \
    int name(const char *path, int flags, ...) {                             \
        va_list rest;                                                        \
        va_start(rest, flags);                                               \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; \
        va_end(rest);                                                        \
        if ((flags & O_CREAT) && fault(below(path))) return -1;              \
        return REAL(name)(path, flags, mode);                                \
    }
OPENING(open)
OPENING(open64)

/* A deletion takes no space either, and is a moment for a signal, too. */
int unlink(const char *path) {
    if (code < 0 || !at) fault(below(path));
    return REAL(unlink)(path);
}
