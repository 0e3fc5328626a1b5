#!/bin/bash
# A Slurm array: task i does every 20th scene from the i-th on. Submit: sbatch slurm.sh
# A task that is killed, preempted or out of time is submitted again; what is done is skipped.
#SBATCH --job-name=sgwarp
#SBATCH --array=0-19
#SBATCH --cpus-per-task=8
#SBATCH --mem=32G
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --output=sgwarp-%A_%a.log

export WARP_CACHE_PATH="$HOME/.cache/warp"  # compiled kernels: one folder for machines with the same processors
export SGWARP_CACHE="${TMPDIR:-/tmp}/sgwarp-maps"  # feature maps: on the machine's own disk

srun sgwarp batch scenes.csv --do fit,lift --out results \
  --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" --workers 2 --threads 4 \
  --time-limit 7200 --memory-limit 14
