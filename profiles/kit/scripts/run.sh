#!/bin/sh
# Times the networks of this kit with trtexec. Run it on the device, at the power mode and clocks
# that you will use. It may be interrupted and run again: what was timed stays, what failed is
# tried once more.
#
#   TRTEXEC=/path/to/trtexec   where it is not found
#   DURATION=10                seconds to time each network for
set -u
cd "$(dirname "$0")" || exit 1

KIT='@KIT@'
REFERENCE='@REFERENCE@'
NETWORKS='@NETWORKS@'
PRECISIONS='@PRECISIONS@'

flags() {
    case $1 in
@FLAGS@
    esac
}

@LOCATE@
LOGS=logs-$KIT
mkdir -p "$LOGS" || exit 1

# What the device is and how fast it was told to run, one "# key: value" a line.
state() {
    echo "# date: $(date -u +%Y-%m-%dT%H:%M:%SZ)"
    echo "# system: $(uname -srm)"
    if [ -r /proc/device-tree/model ]; then
        echo "# board: $(tr -d '\000' </proc/device-tree/model)"
    fi
    if [ -r /etc/nv_tegra_release ]; then
        echo "# l4t: $(head -n 1 /etc/nv_tegra_release | sed 's/^# *//')"
    fi
    if command -v nvpmodel >/dev/null 2>&1; then
        echo "# power mode: $(nvpmodel -q 2>/dev/null | tr '\n' ' ')"
    fi
    if command -v jetson_clocks >/dev/null 2>&1; then
        jetson_clocks --show 2>/dev/null | grep -E 'GPU|EMC' | sed 's/^/# clocks: /'
    fi
    for clock in /sys/class/devfreq/*/cur_freq; do
        if [ -r "$clock" ]; then
            echo "# clock $(basename "$(dirname "$clock")"): $(cat "$clock" 2>/dev/null)"
        fi
    done
    if command -v nvidia-smi >/dev/null 2>&1; then
        asked=name,driver_version,pstate,clocks.sm,clocks.mem,power.limit,temperature.gpu
        nvidia-smi --query-gpu=$asked --format=csv,noheader 2>/dev/null | sed 's/^/# gpu: /'
    fi
    return 0
}

# Whether a log's times are close together: its last percentile within 30% of the median.
steady() {
    grep 'GPU Compute Time: min' "$1" | tail -n 1 | awk '
        {
            for (i = 1; i < NF; i++) {
                at = $(i + 1) == "=" ? i + 2 : i + 1
                if ($i == "median") median = $at
                if ($i == "percentile(99%)") far = $at
                if ($i == "percentile(95%)") near = $at
            }
            if (near == "") near = far
            exit !(median > 0 && near <= 1.3 * median)
        }'
}

# One run of trtexec: NAME and its options. The log gets its name once it is whole.
timed() {
    log=$LOGS/$1.log
    shift
    rm -f "${log%.log}.failed"
    {
        state
        "$TRTEXEC" "$@" --warmUp=500 --duration="${DURATION:-10}" --iterations=50 \
            --noDataTransfers </dev/null
        echo "# ended: $?"
    } >"$log.part" 2>&1
    if grep -q '^&&&& PASSED' "$log.part" && grep -q '^# ended: 0$' "$log.part"; then
        mv "$log.part" "$log"
    else
        mv "$log.part" "${log%.log}.failed"
        return 1
    fi
}

# Up to three times, until the times are close together; the last attempt stays.
tried() {
    [ -f "$LOGS/$1.log" ] && return 0
    for attempt in 1 2 3; do
        timed "$@" || return 1
        if steady "$LOGS/$1.log"; then
            return 0
        fi
        if [ "$attempt" -lt 3 ]; then
            rm -f "$LOGS/$1.log"
        fi
    done
}

failed=0
for precision in $PRECISIONS; do
    engine=$LOGS/reference.$precision.plan
    for network in $NETWORKS; do
        job=$network.$precision
        printf '%s ' "$job"
        if [ -f "$LOGS/$job.log" ] && [ -f "$LOGS/$job.reference.log" ]; then
            echo 'was timed before'
            continue
        fi
        # shellcheck disable=SC2046 # the flags are words
        set -- --onnx="$network.onnx" $(flags "$precision") --timingCacheFile="$LOGS/timing.cache"
        if [ "$network" = "$REFERENCE" ]; then
            set -- "$@" --saveEngine="$engine"
        fi
        if ! tried "$job" "$@"; then
            failed=$((failed + 1))
            echo "FAILED: see $LOGS/$job.failed"
            continue
        fi
        if [ -f "$engine" ]; then
            tried "$job.reference" --loadEngine="$engine" || true
        fi
        grep 'GPU Compute Time: min' "$LOGS/$job.log" | tail -n 1 | sed 's/.*Time: //'
    done
done
echo "$failed failed; now: python3 collect.py"
