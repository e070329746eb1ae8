# Sourced by the scripts in this folder. Sets `root`; the function `environment` makes `.venv`.
# Needs a Python version in `tried` with its venv module (or uv), flock, sha256sum and libgomp. pip installs the
# rest.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
venv=$root/.venv
stamp=$venv/xrl.stamp       # fingerprint of the environment's sources; missing while the environment is made
kind=$venv/xrl.kind         # kind of the environment: full or runtime, as last requested
half_made=$venv/xrl.making  # exists while the environment is made
graphs=$venv/xrl-graphs/stamp  # fingerprint of the sources of the graphs in C

# Let Python cache bytecode: otherwise each process compiles its imports for 0.8 s. A fleet has ten processes.
unset PYTHONDONTWRITEBYTECODE

say() { printf '%s\n' "deploy: $*" >&2; }
die() { say "$*"; exit 2; }  # exit code 1 means that the robot fell

tried="3.14 3.13 3.12 3.11"  # Python versions that the lock files were tested with, preferred first

full=$root/requirements.lock
runtime=$root/requirements.runtime.lock  # for a robot in service
robot_extras="ros2 usb"  # for some robots; requirements.NAME.lock adds their packages to the runtime environment

# Print a fingerprint of the environment's sources and of its path, which its scripts contain.
fingerprint() {  # LOCK
  { printf '%s\n' "$root"; cat "$1" "$root/pyproject.toml"; } | sha256sum
}

is_made_from() {  # LOCK
  [ -x "$venv/bin/python" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(fingerprint "$1")" ]
}

is_current() {  # full, runtime or any
  case "$1" in
    full) is_made_from "$full" ;;
    runtime) is_made_from "$runtime" ;;
    *) is_made_from "$full" || is_made_from "$runtime" ;;
  esac
}

# Print the version of a Python and the time of a loop in it, us, or nothing if it cannot make an environment.
# The loop is timed because builds of one version differ: profile-guided optimisation makes a build up to a
# quarter faster, but builds do not report it reliably.
measure_python() {  # PYTHON
  "$1" -c '
import sys, time, venv, ensurepip
def loop():
    begin, kept = time.perf_counter_ns(), {"sum": 0}
    for i in range(20000):
        kept["sum"] = (kept["sum"] + i) % 11
    return time.perf_counter_ns() - begin
print("%d.%d" % sys.version_info[:2], min(loop() for _ in range(9)) // 1000)' 2>/dev/null
}

# Print the newest Python of `tried` that can make an environment. Among builds of one version, print the first on
# PATH, unless another is over 5 % faster. All matches on PATH are tested, because a version manager's shim may
# come before the real Python.
find_python() {
  local version candidate found us best best_us
  for version in $tried; do
    best="" best_us=0
    while read -r candidate; do
      read -r found us < <(measure_python "$candidate") || continue
      [ "$found" = "$version" ] || continue
      if [ -z "$best" ] || [ "$us" -lt $((best_us * 95 / 100)) ]; then
        [ -z "$best" ] || say "a test loop takes $us us with $candidate, $best_us us with $best"
        best=$candidate best_us=$us
      fi
    done < <(type -aP "python$version" python3 python)
    if [ -n "$best" ]; then
      printf '%s\n' "$best"
      return
    fi
  done
  return 1
}

no_python() {
  local found
  found=$(python3 --version 2>/dev/null) || found="no python3"
  die "none of Python $tried with its venv module is on PATH ($found); install one, for example by" \
    "$(how_to_install "python3-venv" "python3")"
}

# Print how to install a system package, given its names on Debian and on Fedora.
how_to_install() {
  if command -v apt-get >/dev/null; then printf '%s\n' "'apt-get install $1'"
  elif command -v dnf >/dev/null; then printf '%s\n' "'dnf install $2'"
  else printf '%s\n' "your package manager (Debian: $1, Fedora: $2)"
  fi
}

# Wheels contain every system library except libgomp, without which the first import fails with a traceback.
# (Drives over USB also need libusb-1.0, which shared/extras.py checks.)
check_libraries() {  # PYTHON
  "$1" -c 'import ctypes; ctypes.CDLL("libgomp.so.1")' 2>/dev/null ||
    die "libgomp.so.1 is missing, which Pinocchio needs; install it with" \
      "$(how_to_install libgomp1 libgomp)"
}

make_venv() {
  local python
  if python=$(find_python); then
    say "making .venv with $("$python" --version), $python (once; a minute or two)"
    check_libraries "$python"
    fresh_folder
    "$python" -m venv "$venv" || die "$python -m venv failed, see above"
  elif command -v uv >/dev/null; then
    say "making .venv with uv and Python ${tried%% *} (once; a minute or two)"
    fresh_folder
    uv venv --quiet --seed --allow-existing --python "${tried%% *}" "$venv" ||
      die "uv venv failed, see above"
    check_libraries "$venv/bin/python"
  else
    no_python
  fi
}

fresh_folder() {
  mkdir -p "$venv" && : >"$half_made"  # set the mark before the old files are deleted
  find "$venv" -mindepth 1 ! -path "$half_made" -delete
}

venv_is_sound() { [ ! -e "$half_made" ] && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }

make_environment() {  # LOCK
  local lock=$1 compiled=--no-compile  # compile at first import: saves 14 of 50 s
  [ "$lock" != "$runtime" ] || compiled=--compile  # the services' user may not write there
  rm -f "$stamp"
  if [ "$lock" = "$runtime" ] || ! venv_is_sound; then  # a runtime environment has no other packages
    make_venv
  else
    say "updating .venv"
    : >"$half_made"
  fi
  "$venv/bin/python" -m pip install --quiet "$compiled" --require-hashes --only-binary :all: \
    --requirement "$lock" &&
    "$venv/bin/python" -m pip install --quiet --no-deps --no-build-isolation --editable "$root" ||
    die "pip could not install the locked packages, see above; the next attempt starts from scratch"
  fingerprint "$lock" >"$stamp"
  rm -f "$half_made"
}

add_extras() {  # NAME...
  local extra
  for extra; do
    "$venv/bin/python" -m pip install --quiet --compile --require-hashes --only-binary :all: --no-deps \
      --requirement "$root/requirements.$extra.lock" || die "pip could not add $extra, see above"
  done
}

# Print a fingerprint of the graphs' sources. Each library also contains the hash of its graph.
graphs_fingerprint() {
  { command -v cc; cat "$stamp" "$root"/services/planner/law/{symbolic,model,certificate}.py \
    "$root"/services/simulator/physics/{body,actuation,plant}.py \
    "$root"/services/simulator/drives/axis_control.py "$root"/shared/robot/compiled_graph.py \
    "$root"/tools/graph_libraries.py "$root"/deploy/robot.toml; } 2>/dev/null | sha256sum || true
}

graphs_are_current() { [ "$(cat "$graphs" 2>/dev/null)" = "$(graphs_fingerprint)" ]; }

# Translate the graphs into C for speed. A failure is only reported, because CasADi can interpret the graphs.
translate_graphs() {
  local from
  from=$(graphs_fingerprint)
  (cd "$root" && "$venv/bin/python" -m tools.graph_libraries && mkdir -p "${graphs%/*}" &&
    printf '%s\n' "$from" >"$graphs") || say "the law's graphs stay interpreted: slower, with the same results"
}

# Print the kind of environment to make. With `any` it stays the same, so a `git pull` keeps a runtime environment.
kind_for() {  # full, runtime or any
  local was
  was=$(cat "$kind" 2>/dev/null) || was=full
  [ "$1" = any ] && printf '%s\n' "$was" || printf '%s\n' "$1"
}

# Make `.venv` from the lock file, or return at once if it is current. If another script is making it, wait. After
# an interruption, the next script starts from scratch.
environment() {  # [full | runtime], default: either
  local wanted=${1:-any} lock=$full made_as
  made_as=$(kind_for "$wanted")
  [ "$made_as" != runtime ] || lock=$runtime
  is_current "$wanted" && graphs_are_current && return
  command -v flock >/dev/null || die "flock is missing (package util-linux)"
  exec 9<"$root"
  flock --nonblock 9 || { say "waiting for another script that is making .venv"; flock 9; }
  if ! is_current "$wanted"; then
    make_environment "$lock"
    printf '%s\n' "$made_as" >"$kind"
  fi
  graphs_are_current || translate_graphs
  exec 9<&-
}

# Replace this shell with `xrl`, which then receives Ctrl-C directly.
xrl() {
  environment
  exec "$venv/bin/xrl" "$@"
}
