# Sourced by the scripts beside it: goes to the root of the project, and makes the environment in .venv.
# shellcheck shell=bash

cd "$(dirname "${BASH_SOURCE[0]}")/.."

# What jaxlib prints, at level "error", whenever it reads its cache of compiled code says nothing to anybody.
export TF_CPP_MIN_LOG_LEVEL="${TF_CPP_MIN_LOG_LEVEL:-3}"

fail() {
  echo "$(basename "$0"): $*" >&2
  exit 2
}

is_recent() { # whether a command is a Python that will do; a name on the PATH need not lead to one that runs
  "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

find_python() { # sets $python
  if [[ -n "${PYTHON:-}" ]]; then
    is_recent "$PYTHON" || fail "PYTHON=$PYTHON does not run Python 3.11 or later"
    python=$PYTHON
    return
  fi
  for python in python3.11 python3.12 python3.13 python3 python; do
    is_recent "$python" && return
  done
  fail "needs Python 3.11 or later, and found none; PYTHON=/path/to/python says where one is"
}

make_venv() { # an environment with pip in it, from whatever of venv, ensurepip and pip this machine has
  rm -rf .venv
  if ! "$python" -m venv .venv >/dev/null 2>&1; then
    rm -rf .venv
    "$python" -m venv --without-pip .venv && "$python" -m pip -qq --python .venv/bin/python install pip ||
      fail "$python could not make an environment in .venv; on Debian and Ubuntu: apt install python3-venv"
  fi
}

prepare() { # prepare [EXTRA]: installs the project, unless that was done with the same pyproject.toml, in this place
  local extra=${1:-} wanted python=""
  wanted=$(pwd && cat pyproject.toml)
  if ! is_recent .venv/bin/python || ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    find_python
  elif is_installed "${extra:-base}" "$wanted" || is_installed test "$wanted"; then
    return
  fi
  echo "Installing linemap_jax and what it needs into .venv; this takes a minute."
  if [[ -n "$python" ]]; then
    make_venv
  fi
  install_python --editable ".${extra:+[$extra]}" || fail "the installation did not succeed; what pip said stands above"
  echo "$wanted" >".venv/installed-${extra:-base}"
}

install_python() { # by uv, which takes a third of the time; by pip where uv does not run
  local pip=(.venv/bin/python -m pip install -qq --disable-pip-version-check)
  if "${pip[@]}" uv >/dev/null 2>&1 && .venv/bin/python -m uv pip install -q --python .venv/bin/python "$@" 2>/dev/null; then
    return
  fi
  "${pip[@]}" "$@"
}

is_installed() { # is_installed EXTRA WANTED
  [[ -f ".venv/installed-$1" && "$(<".venv/installed-$1")" == "$2" ]]
}
