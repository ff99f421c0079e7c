"""The half of the extension that needs no Blender: plain Python and numpy, tested without bpy.

errors      what a person reads       interpreter  which Python has gsopt
job         start, watch, end         run          follow a run directory
splats      the record and its sums   ply, spz     splat files
cameras     datasets' views           prompts      prompts.json
arguments   settings to flags         dataset      how far a rendering is
"""
