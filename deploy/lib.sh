# Sourced by the scripts beside it: sets `root` and, through `environment`, makes `.venv`.
# Needs a Python that the lock was tried with (and its venv module, or uv), flock and sha256sum, and
# libgomp; everything else comes with pip.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
venv=$root/.venv
stamp=$venv/xrl.stamp       # what the environment was made from; absent while it is being made
kind=$venv/xrl.kind         # full or runtime, as it was asked for last
half_made=$venv/xrl.making  # stands from the first to the last step of making it
graphs=$venv/xrl-graphs/stamp  # what the law's graphs were translated into C from, where cc is

# A fleet is ten processes, the tests start hundreds: without it each compiles all it imports, 0.8 s.
unset PYTHONDONTWRITEBYTECODE

say() { printf '%s\n' "deploy: $*" >&2; }
die() { say "$*"; exit 2; }  # 1 is a robot that fell

tried="3.14 3.13 3.12 3.11"  # Pythons that the lock files were tried with, the preferred one first

full=$root/requirements.lock
runtime=$root/requirements.runtime.lock  # what a robot in service needs
robot_extras="ros2 usb"  # what only some robots need; requirements.NAME.lock adds it to the runtime's

# The environment is right while this stays the same; scripts in it hold its absolute path.
fingerprint() {  # LOCK
  { printf '%s\n' "$root"; cat "$1" "$root/pyproject.toml"; } | sha256sum
}

is_made_from() {  # LOCK
  [ -x "$venv/bin/python" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(fingerprint "$1")" ]
}

is_current() {  # full, runtime, or any: as it is
  case "$1" in
    full) is_made_from "$full" ;;
    runtime) is_made_from "$runtime" ;;
    *) is_made_from "$full" || is_made_from "$runtime" ;;
  esac
}

# Prints a Python's version and the time of a loop in it, us; nothing if it cannot make an environment.
# Builds of one version differ: one with profile-guided optimisation is up to a quarter faster, and
# no build says reliably whether it is one.
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

# The newest Python that the lock was tried with, of those that can make an environment; of several
# builds the first on PATH, unless another is clearly faster. Not the first of a name only: a version
# manager's shim may stand before the real one.
find_python() {
  local version candidate found us best best_us
  for version in $tried; do
    best="" best_us=0
    while read -r candidate; do
      read -r found us < <(measure_python "$candidate") || continue
      [ "$found" = "$version" ] || continue
      if [ -z "$best" ] || [ "$us" -lt $((best_us * 95 / 100)) ]; then
        [ -z "$best" ] || say "$candidate takes $us us for a loop, $best $best_us us"
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
  die "no Python of $tried with its venv module on PATH ($found); install it, for example by" \
    "$(how_to_install "python3-venv" "python3")"
}

# The command that brings a package of the system: Debian's name, Fedora's name.
how_to_install() {
  if command -v apt-get >/dev/null; then printf '%s\n' "'apt-get install $1'"
  elif command -v dnf >/dev/null; then printf '%s\n' "'dnf install $2'"
  else printf '%s\n' "your package manager (Debian: $1, Fedora: $2)"
  fi
}

# Wheels bring all but one library of the system. Without it the first import would be a traceback.
# (Drives over USB want libusb-1.0 as well; who uses them is told so, shared/extras.py.)
check_libraries() {  # PYTHON
  "$1" -c 'import ctypes; ctypes.CDLL("libgomp.so.1")' 2>/dev/null ||
    die "the library libgomp.so.1 is missing, which Pinocchio needs; install it:" \
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
  mkdir -p "$venv" && : >"$half_made"  # the mark stands while what was there before goes
  find "$venv" -mindepth 1 ! -path "$half_made" -delete
}

venv_is_sound() { [ ! -e "$half_made" ] && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }

make_environment() {  # LOCK
  local lock=$1 compiled=--no-compile  # where it is first imported, 14 s of the 50 are saved
  [ "$lock" != "$runtime" ] || compiled=--compile  # who runs it may not write there
  rm -f "$stamp"
  if [ "$lock" = "$runtime" ] || ! venv_is_sound; then  # nothing else is left in a robot's
    make_venv
  else
    say "bringing .venv up to date"
    : >"$half_made"
  fi
  "$venv/bin/python" -m pip install --quiet "$compiled" --require-hashes --only-binary :all: \
    --requirement "$lock" &&
    "$venv/bin/python" -m pip install --quiet --no-deps --no-build-isolation --editable "$root" ||
    die "pip could not install the locked packages, see above; the next try starts afresh"
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

# The graphs' C is right while this stays the same; a library also carries its graph's hash.
graphs_fingerprint() {
  { command -v cc; cat "$stamp" "$root"/services/planner/law/{symbolic,model,certificate}.py \
    "$root"/services/simulator/physics/{body,actuation,plant}.py \
    "$root"/services/simulator/drives/axis_control.py "$root"/shared/robot/compiled_graph.py \
    "$root"/tools/graph_libraries.py "$root"/deploy/robot.toml; } 2>/dev/null | sha256sum || true
}

graphs_are_current() { [ "$(cat "$graphs" 2>/dev/null)" = "$(graphs_fingerprint)" ]; }

# Speed only: what cannot be translated is said, and CasADi interprets it.
translate_graphs() {
  local from
  from=$(graphs_fingerprint)
  (cd "$root" && "$venv/bin/python" -m tools.graph_libraries && mkdir -p "${graphs%/*}" &&
    printf '%s\n' "$from" >"$graphs") || say "the law's graphs stay interpreted: slower, else the same"
}

# After a `git pull` a robot's environment is a robot's again, whichever script makes it.
kind_for() {  # full, runtime, or any: as it was
  local was
  was=$(cat "$kind" 2>/dev/null) || was=full
  [ "$1" = any ] && printf '%s\n' "$was" || printf '%s\n' "$1"
}

# Make `.venv` from the lock file, or do nothing, quickly, if it is right already.
# Two at once: the second waits. Stopped in the middle: the next one starts afresh.
environment() {  # [full | runtime]: either is right without
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

# Become the verb of the command line: no shell stands between a Ctrl-C and the tool.
xrl() {
  environment
  exec "$venv/bin/xrl" "$@"
}
