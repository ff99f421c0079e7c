"""Posed datasets from meshes, rendered by Blender. The flow of one object, a module a step:

settings  what was asked for            items     which meshes, and what is known about them
meshfile  refuse what would hang        stage     mesh into the unit sphere (bpy)
cameras   where the views stand         studio    lights, lens, renderer (bpy)
exr       passes off the disk           pixels    passes to images, contact sheets
points    coloured surface samples      captions  words for an object and its views
export    transforms.json and COLMAP    render    all of the above for one object: the seam for other schedulers
crew      worker processes              library   a whole run: resume, dataset.json, failures.json

Only stage, studio and render touch bpy, and only when called.
"""
