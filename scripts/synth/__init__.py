"""Posed datasets from meshes, rendered by Blender. The flow of one object, a module a step:

settings        the options of a run           mesh_items           meshes, and what is known about them
meshfile        refuses what would hang        import_mesh          mesh into the unit sphere (bpy)
cameras         camera poses of the views      lighting_and_render  lights, lens, renderer (bpy)
exr             passes from the disk           pixels               passes to images, contact sheets
points          colored surface samples        captions             words for an object and its views
export          transforms.json and COLMAP     render_object        all of the above for one object
worker_pool     worker processes               render_dataset       a whole run: resume, dataset.json, failures.json
coincident_faces separates the two sides of flat sheets (bpy)

`render_object` is the seam for other schedulers. Only it and the modules marked (bpy) use bpy, when called.
"""
