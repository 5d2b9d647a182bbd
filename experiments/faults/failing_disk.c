/* A disk that becomes full or read-only, for programs that load this library.
 *
 * FAULT_FOLDER is the folder whose files are affected. While FAULT_SWITCH.full exists,
 * what writes data there fails with ENOSPC. While FAULT_SWITCH.readonly exists, what
 * changes anything there fails with EROFS.
 *
 *     cc -shared -fPIC -o failing_disk.so failing_disk.c -ldl
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *folder(void) { return getenv("FAULT_FOLDER"); }

static int is_on(const char *kind) {
  const char *name = getenv("FAULT_SWITCH");
  char path[PATH_MAX];
  if (!name || !folder()) return 0;
  snprintf(path, sizeof path, "%s.%s", name, kind);
  return faccessat(AT_FDCWD, path, F_OK, 0) == 0;
}

static int is_inside(int at, const char *path) {
  char start[PATH_MAX] = "", link[64];
  size_t length = strlen(folder());
  if (!path) return 0;
  if (path[0] == '/') return strncmp(path, folder(), length) == 0;
  if (at == AT_FDCWD) {
    if (!getcwd(start, sizeof start)) return 0;
  } else {
    snprintf(link, sizeof link, "/proc/self/fd/%d", at);
    if (readlink(link, start, sizeof start - 1) < 0) return 0;
  }
  return strncmp(start, folder(), length) == 0;
}

static int is_open_inside(int file) {
  char path[PATH_MAX] = "", link[64];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  if (readlink(link, path, sizeof path - 1) < 0) return 0;
  return path[0] == '/' && strncmp(path, folder(), strlen(folder())) == 0;
}

/* The error of writing data to an open file, 0 for none. */
static int data_error(int file) {
  int kept = errno, error = 0;
  if (is_on("full")) error = is_open_inside(file) ? ENOSPC : 0;
  else if (is_on("readonly")) error = is_open_inside(file) ? EROFS : 0;
  errno = kept;
  return error;
}

/* The error of changing a folder; making something needs room as well. */
static int name_error(int at, const char *path, int makes) {
  int kept = errno, error = 0;
  if (is_on("readonly")) error = is_inside(at, path) ? EROFS : 0;
  else if (makes && is_on("full")) error = is_inside(at, path) ? ENOSPC : 0;
  errno = kept;
  return error;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define FAIL(error) do { int e = (error); if (e) { errno = e; return -1; } } while (0)

#define WRITES(type, name, parameters, arguments) \
  type name parameters { FAIL(data_error(file)); return REAL(name) arguments; }
WRITES(ssize_t, write, (int file, const void *data, size_t size), (file, data, size))
WRITES(ssize_t, pwrite, (int file, const void *data, size_t size, off_t at),
       (file, data, size, at))
WRITES(ssize_t, pwrite64, (int file, const void *data, size_t size, off64_t at),
       (file, data, size, at))
WRITES(ssize_t, writev, (int file, const struct iovec *parts, int count),
       (file, parts, count))
WRITES(ssize_t, pwritev, (int file, const struct iovec *parts, int count, off_t at),
       (file, parts, count, at))
WRITES(ssize_t, sendfile, (int file, int from, off_t *at, size_t size),
       (file, from, at, size))
WRITES(ssize_t, sendfile64, (int file, int from, off64_t *at, size_t size),
       (file, from, at, size))
WRITES(int, ftruncate, (int file, off_t size), (file, size))
WRITES(int, ftruncate64, (int file, off64_t size), (file, size))

ssize_t copy_file_range(int from, off64_t *at, int file, off64_t *to, size_t size,
                        unsigned flags) {
  FAIL(data_error(file));
  return REAL(copy_file_range)(from, at, file, to, size, flags);
}

#define CHANGES(name, parameters, arguments, at, path, makes) \
  int name parameters { FAIL(name_error(at, path, makes)); return REAL(name) arguments; }
CHANGES(mkdir, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path, 1)
CHANGES(mkdirat, (int at, const char *path, mode_t mode), (at, path, mode), at, path, 1)
CHANGES(rmdir, (const char *path), (path), AT_FDCWD, path, 0)
CHANGES(unlink, (const char *path), (path), AT_FDCWD, path, 0)
CHANGES(unlinkat, (int at, const char *path, int flags), (at, path, flags), at, path, 0)
CHANGES(rename, (const char *from, const char *path), (from, path), AT_FDCWD, path, 0)
CHANGES(renameat, (int from, const char *old, int at, const char *path),
        (from, old, at, path), at, path, 0)
CHANGES(symlink, (const char *to, const char *path), (to, path), AT_FDCWD, path, 1)
CHANGES(chmod, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path, 0)

static int changes(int flags) {
  return (flags & O_ACCMODE) != O_RDONLY || (flags & (O_CREAT | O_TRUNC));
}

#define OPENS(name) \
  int name(const char *path, int flags, ...) { \
    va_list rest; va_start(rest, flags); \
    mode_t mode = va_arg(rest, mode_t); va_end(rest); \
    if (changes(flags)) FAIL(name_error(AT_FDCWD, path, 0)); \
    return REAL(name)(path, flags, mode); \
  }
OPENS(open)
OPENS(open64)

#define OPENS_AT(name) \
  int name(int at, const char *path, int flags, ...) { \
    va_list rest; va_start(rest, flags); \
    mode_t mode = va_arg(rest, mode_t); va_end(rest); \
    if (changes(flags)) FAIL(name_error(at, path, 0)); \
    return REAL(name)(at, path, flags, mode); \
  }
OPENS_AT(openat)
OPENS_AT(openat64)

#define OPENS_STREAM(name) \
  FILE *name(const char *path, const char *mode) { \
    int error = strpbrk(mode, "wa+") ? name_error(AT_FDCWD, path, 0) : 0; \
    if (error) { errno = error; return NULL; } \
    return REAL(name)(path, mode); \
  }
OPENS_STREAM(fopen)
OPENS_STREAM(fopen64)
