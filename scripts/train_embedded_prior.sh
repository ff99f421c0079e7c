#!/bin/sh
# How gsopt/sds/embedded was made: renders of meshes, reconstructions of them from few views, training in three courses.
#
#     scripts/train_embedded_prior.sh BLENDER_PYTHON MESHES SPLITS LIBRARIES OUT
#
# BLENDER_PYTHON has bpy; MESHES holds MANIFEST.json and the meshes it lists; SPLITS is a JSON file with the names under
# `train` and `val`; LIBRARIES are the unpacked archives of sweethome3d-furniture (more_models.py). Interrupted, the same
# command goes on. Each course ran before the next was thought of, with the first shapes, the mirror images and the loss of
# its time: what this makes today is not the same to the bit. The weights were rounded to 8 significant bits afterwards
# (gsopt/finetune/half_precision.py).
set -eu
blender_python=$1 meshes=$2 splits=$3 libraries=$4 out=$5
mkdir -p "$out"

for part in train val; do
    python - "$meshes" "$splits" "$part" > "$out/$part.json" <<'END'
import json, pathlib, sys

meshes, splits, part = sys.argv[1:]
rows = {row["id"]: row for row in json.loads(pathlib.Path(meshes, "MANIFEST.json").read_text())}
wanted = [rows[name] for name in json.loads(pathlib.Path(splits).read_text())[part] if name in rows]
keys = ("name", "category", "license", "creator")
print(json.dumps([{
    "id": row["id"].split("/")[-1],
    "mesh": str(pathlib.Path(meshes, row["obj"]).resolve()),
    **{key: row[key] for key in keys},
} for row in wanted]))
END
done
python scripts/more_models.py "$libraries" "$meshes" "$splits" --most 180 > "$out/more.json"
for part in train val more; do
    "$blender_python" scripts/synth_views.py --manifest "$out/$part.json" -o "$out/$part" --views 24 --test-views 0 \
        --resolution 128 --samples 12 --format nerf --captions --workers 2 --threads 1 --resume
done

held_out=$(python -c 'import json, sys; print(*(row["id"] for row in json.load(open(sys.argv[1]))))' "$out/val.json")
# shellcheck disable=SC2086
gsopt finetune "$out/train" "$out/val" -o "$out/first" --val $held_out --fits 1 --steps 2500 --lr 5e-4 --threads 1 \
    --clip-steps 0
# shellcheck disable=SC2086
gsopt finetune "$out/train" "$out/more" "$out/val" -o "$out/second" --base "$out/first" --val $held_out --fits 1 \
    --steps 3200 --lr 4e-4 --threads 1
# shellcheck disable=SC2086
gsopt finetune "$out/train" "$out/more" "$out/val" -o "$out/prior" --base "$out/second" --val $held_out --fits 2 \
    --steps 3600 --lr 4e-4 --threads 1
