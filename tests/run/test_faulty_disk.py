"""Runs on file systems whose calls fail: a function loaded before the C library's answers in their place."""

from __future__ import annotations

import errno
import random
import shutil
import subprocess

import pytest
from program import EVERY, SMALL, command, environment, one_line
from test_full_disk import LOOSE, check_whole

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

/* Whether this call is the one that fails: FAULT_CALL number FAULT_AT (0: each) for a file in a folder out. */
static int fails(const char *call, int fd, const char *path) {
  static int count = 0;
  const char *wanted = getenv("FAULT_CALL"), *at = getenv("FAULT_AT");
  char link[64], name[4096] = "";
  if (!wanted || !at || strcmp(wanted, call)) return 0;
  if (!path) {
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, name, sizeof name - 1);
    name[n > 0 ? n : 0] = 0;
    path = name;
  }
  if (!strstr(path, "out/")) return 0;
  count++;
  return atoi(at) == 0 || count == atoi(at);
}
#define ERROR atoi(getenv("FAULT_ERRNO"))
#define FD(type, name, args, call, bad) \
  type name args { \
    if (fails(#name, fd, NULL)) bad \
    type (*real) args = dlsym(RTLD_NEXT, #name); \
    return real call; \
  }
#define MINUS { errno = ERROR; return -1; }
FD(ssize_t, write, (int fd, const void *data, size_t n), (fd, data, n), MINUS)
FD(ssize_t, pwrite64, (int fd, const void *data, size_t n, off64_t at), (fd, data, n, at), MINUS)
FD(ssize_t, pwrite, (int fd, const void *data, size_t n, off_t at), (fd, data, n, at), MINUS)
FD(int, fsync, (int fd), (fd), MINUS)
FD(int, ftruncate64, (int fd, off64_t n), (fd, n), MINUS)
int rename(const char *from, const char *to) {
  if (fails("rename", -1, to)) MINUS
  int (*real)(const char *, const char *) = dlsym(RTLD_NEXT, "rename");
  return real(from, to);
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    (folder / "faults.c").write_text(SOURCE)
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no compiler of C")
    line = [compiler, "-shared", "-fPIC", "-O1", "-o", "faults.so", "faults.c", "-ldl"]
    if subprocess.run(line, cwd=folder, capture_output=True, check=False).returncode:
        pytest.skip("the compiler of C makes no library to load first")
    return folder / "faults.so"


@pytest.fixture
def run(library, cache, tmp_path):
    """`run(call, at, number, *options)` makes steps where the call fails at that time with that error (0: always)."""

    def run(call, at, number, *options):
        fault = {"LD_PRELOAD": str(library), "FAULT_CALL": call, "FAULT_AT": str(at), "FAULT_ERRNO": str(number)}
        words = command(*SMALL, *EVERY, *LOOSE, "-output", "out", "-quiet", *options)
        return subprocess.run(
            words, cwd=tmp_path, env={**environment(cache), **fault}, capture_output=True, text=True, timeout=120
        )

    return run


@pytest.mark.slow
def test_a_call_that_fails_once_ends_a_run_with_one_line_and_spares_what_was_written(run, tmp_path):
    rng, failed = random.Random(3), 0
    run("none", 0, 0, "-steps", 2)
    for _ in range(40):
        before = check_whole(tmp_path / "out")
        call = rng.choice(["write", "fsync", "ftruncate64", "rename"])
        number = rng.choice([errno.EIO, errno.ENOSPC, errno.EDQUOT])
        at = rng.randint(1, 40)
        done = run(call, at, number, "-restart", "out/checkpoint.h5", "-steps", 2)
        what = f"{call} {at} {errno.errorcode[number]}: {done.returncode}\n{done.stderr}"
        assert done.returncode in (0, 2), what
        if done.returncode == 2:
            one_line(done, 2)
        else:
            assert "pctt.run: " not in done.stderr, what
        failed += done.returncode == 2
        assert before <= check_whole(tmp_path / "out") <= before + 2, what
    assert failed >= 10
    assert run("none", 0, 0, "-restart", "out/checkpoint.h5", "-steps", 1).returncode == 0
