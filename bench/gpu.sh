#!/usr/bin/env bash
# Everything there is to know about the CUDA backend on one GPU: bench/gpu.sh FOLDER [stage ...]
# Stages: build tests bench sanitize train (all by default). Leaves FOLDER/cuda.json and a log of each stage.
set -uo pipefail
cd "$(dirname "$0")/.."
OUT=$(mkdir -p "${1:?usage: bench/gpu.sh FOLDER [stage ...]}" && cd "$1" && pwd)
shift
STAGES=${*:-build tests bench sanitize train}
PYTHON=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
export PYTHONUNBUFFERED=1
FAILED=""

# Where gsparc is not installed (-P: the folders here are not the package), lay its rooms out under their installed names and build the CPU kernels there.
if ! "$PYTHON" -P -c "import gsparc.ops._native" 2>/dev/null; then
  SITE="$PWD/build/site"
  rm -rf "$SITE" && mkdir -p "$SITE/gsparc" build/cpu
  cp -rs "$PWD"/gsparc/. "$SITE/gsparc/"
  for room in ops callbacks conf; do cp -rs "$PWD/$room" "$SITE/gsparc/"; done
  (cmake -S . -B build/cpu -G Ninja -DCMAKE_BUILD_TYPE=Release -DPython_EXECUTABLE="$(command -v "$PYTHON")" &&
    cmake --build build/cpu) >"$OUT/cpu-kernels.log" 2>&1 || tail -5 "$OUT/cpu-kernels.log"
  cp build/cpu/ops/csrc/_native*.so "$SITE/gsparc/ops/"
  export PYTHONPATH="$SITE${PYTHONPATH:+:$PYTHONPATH}"
fi

stage() { # stage NAME LIMIT_S COMMAND...
  local name=$1 limit=$2 started=$SECONDS
  shift 2
  [[ " $STAGES " == *" $name "* ]] || return 0
  echo "== $name"
  timeout "$limit" "$@" >"$OUT/$name.log" 2>&1
  local status=$?
  tail -n "${LINES_SHOWN:-25}" "$OUT/$name.log"
  echo "== $name: exit $status after $((SECONDS - started)) s"
  "$PYTHON" bench/gpu.py note "$OUT/cuda.json" "$name" "$status" "$((SECONDS - started))"
  [ $status -eq 0 ] || FAILED="$FAILED $name"
}

sanitize() {
  command -v compute-sanitizer >/dev/null || { echo "compute-sanitizer is not here; skipped"; return 0; }
  local worst=0
  for tool in memcheck racecheck synccheck; do
    echo "-- $tool"
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 timeout 95 compute-sanitizer --tool "$tool" --error-exitcode 7 \
      "$PYTHON" bench/gpu.py short || worst=$?
  done
  return $worst
}
export -f sanitize
export PYTHON

stage build 300 "$PYTHON" bench/gpu.py build "$OUT/cuda.json"
stage tests 240 "$PYTHON" -P -m pytest tests/cuda -q --maxfail=20 -k "gpu or test_device" -p no:cacheprovider
stage bench 200 "$PYTHON" bench/gpu.py bench "$OUT/cuda.json"
stage sanitize 290 bash -c sanitize
stage train 290 "$PYTHON" bench/gpu.py train "$OUT/cuda.json"
"$PYTHON" bench/gpu.py table "$OUT/cuda.json" | tee "$OUT/cuda.md"
[ -z "$FAILED" ] || { echo "failed:$FAILED"; exit 1; }
