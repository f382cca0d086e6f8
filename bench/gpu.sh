#!/usr/bin/env bash
# Checks of the CUDA backend on one GPU: bench/gpu.sh FOLDER [stage ...]
# Stages: build tests hard sanitize bench train (all by default). Leaves a log of each stage in FOLDER, also where one fails; in
# ten minutes at a time: "build tests hard sanitize", "bench train". WHEELS: a folder of what is missing here (bench/wheels.sh).
set -uo pipefail
cd "$(dirname "$0")/.."
OUT=$(mkdir -p "${1:?usage: bench/gpu.sh FOLDER [stage ...]}" && cd "$1" && pwd)
shift
STAGES=${*:-build tests hard sanitize bench train}
PYTHON=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
export PYTHONUNBUFFERED=1
FAILED=""

# What is missing comes from the folder WHEELS; nothing that is here is replaced.
if [ -n "${WHEELS:-}" ]; then
  SPARE="$PWD/build/spare"
  mkdir -p "$SPARE"
  for wheel in "$WHEELS"/*.whl; do
    name=$(basename "$wheel")
    "$PYTHON" -P -c "import importlib.metadata as m, sys; m.version(sys.argv[1])" "${name%%-*}" 2>/dev/null ||
      "$PYTHON" -m pip install --quiet --no-index --no-deps --no-cache-dir --upgrade --target "$SPARE" "$wheel" 2>>"$OUT/wheels.log"
  done
  export PYTHONPATH="$SPARE${PYTHONPATH:+:$PYTHONPATH}"
fi

# Where gsparc is not installed (-P: the folders here are not the package), it is installed beside these sources.
if ! "$PYTHON" -P -c "import gsparc.ops._native" 2>/dev/null; then
  "$PYTHON" -m pip install --quiet --no-index --no-deps --no-build-isolation --upgrade --target "$PWD/build/site" . \
    >"$OUT/install.log" 2>&1 || tail -5 "$OUT/install.log"
  export PYTHONPATH="$PWD/build/site${PYTHONPATH:+:$PYTHONPATH}"
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
  [ $status -eq 0 ] || FAILED="$FAILED $name"
}

sanitize() {
  command -v compute-sanitizer >/dev/null || { echo "compute-sanitizer is not here; skipped"; return 0; }
  local worst=0 ours=()
  # Only kernels of this project, and no calls of torch's that fail as a matter of course; older tools have no such choice.
  compute-sanitizer --help | grep -q -- "--kernel-name " && ours=(--kernel-name kns=gsparc --report-api-errors no)
  for tool in memcheck racecheck synccheck; do
    echo "-- $tool"
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 timeout 95 compute-sanitizer --tool "$tool" --error-exitcode 7 "${ours[@]}" \
      "$PYTHON" -P -m pytest tests/cuda/test_watched.py -q -k "every_kernel and gpu" -p no:cacheprovider || worst=$?
  done
  return $worst
}
train() { # the splatted field, on the GPU and on the CPU: the figures of both stand in train.log
  for accelerator in gpu cpu; do
    "$PYTHON" -P train.py experiment=demo dataset.root=build/stand-ins dataset.count=160 "baselines=[nearest]" trainer.accelerator=$accelerator \
      model.effects.array=false model.effects.phase=false hydra.run.dir="$OUT/train-$accelerator" || return
  done
}
bench() { # the same kernels on the GPU and on all cores of the CPU
  for device in cuda cpu; do
    "$PYTHON" -P -m gsparc bench device=$device "counts=[1000,10000,62000,1000000]" hydra.run.dir="$OUT/bench-$device" || return
  done
}
export -f sanitize bench train
export PYTHON OUT

stage build 300 "$PYTHON" -P -m gsparc.ops.cuda_library
stage tests 240 "$PYTHON" -P -m pytest tests/cuda tests/ops -q --maxfail=20 -k "gpu or test_device" -p no:cacheprovider
stage hard 240 "$PYTHON" -P -m pytest tests/hard_cases -q --maxfail=20 -m "not slow" -k "cuda and not shim" -p no:cacheprovider
stage sanitize 290 bash -c sanitize
LINES_SHOWN=130 stage bench 290 bash -c bench
stage train 290 bash -c train
[ -z "$FAILED" ] || { echo "failed:$FAILED"; exit 1; }
