"""A cluster of one machine: SLURM's commands as scripts. It takes one job at a time."""

from __future__ import annotations

from pathlib import Path

__all__ = ["write_cluster"]

_SCRIPTS = {
    "sbatch": """
here=$(dirname "$0")
if ! grep -q '^#SBATCH --partition=' "$1" || grep -q '^#SBATCH --array=' "$1"; then
    echo "sbatch: error: one job at a time, and in a partition" >&2
    exit 1
fi
rm -f "$here/ended"
sed 's/%j/7/g; s/%t/0/g' "$1" > "$here/job.sh"
export SLURM_JOB_ID=7 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0 SLURM_JOB_NODELIST=localhost
export SLURM_NTASKS=1 SLURM_PROCID=0 SLURM_LOCALID=0
(sh "$here/job.sh"; touch "$here/ended") > "$here/log" 2>&1 &
echo "Submitted batch job 7"
""",
    # Options end where the program of the job begins. Real jobs wait in a queue, while what they
    # are to do is put where they look for it.
    "srun": """
while [ "${1#-}" != "$1" ]; do
    case "$1" in
        --output) output=$2; shift 2 ;;
        --error) error=$2; shift 2 ;;
        *) shift ;;
    esac
done
for _ in $(seq 600); do
    [ -e "$(dirname "$output")/7_submitted.pkl" ] && break
    sleep 0.1
done
exec "$@" >> "$output" 2>> "$error"
""",
    "sacct": """
state=RUNNING
if [ -e "$(dirname "$0")/ended" ]; then state=COMPLETED; fi
printf 'JobID|State|NodeList\\n7|%s|localhost\\n' "$state"
""",
    "scontrol": """
echo localhost
""",
}


def write_cluster(folder: Path) -> Path:
    """Write the commands; returns the folder, to be put on PATH."""
    folder.mkdir(parents=True)
    for name, script in _SCRIPTS.items():
        path = folder / name
        path.write_text(f"#!/bin/sh\n{script.strip()}\n")
        path.chmod(0o755)
    return folder
