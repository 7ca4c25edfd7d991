#!/usr/bin/env bash
# One share of a study for each task of a job array (Slurm), then one job that joins them:
#
#   array=$(sbatch --parsable --array=1-40 examples/cluster/job_array.sh fig2 --seeds 10)
#   sbatch --dependency=afterok:$array examples/cluster/job_array.sh fig2 --seeds 10
#
# Shares do not wait for each other. A share that failed is computed again by its number:
# cells that are stored are not computed twice.
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
set -euo pipefail

if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
  part="--shard $SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT"
else
  part=--merge
fi
exec sim2gp reproduce "$@" --workers 1 $part
