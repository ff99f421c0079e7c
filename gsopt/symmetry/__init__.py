"""Symmetry: one half of an object often shows what few photos miss of the other.

Most things that people make, and many that grow, are symmetric. The silhouettes of 4 photos determine whether an object
is, and the plane of its mirror to a fraction of a degree: `search` finds candidates, `silhouettes` refines and tests
them, `colors` tests whether the paint is symmetric too. Each photo then counts once more for every mirror, as the image
that a camera behind that mirror takes (`find`). From one to three photos only upright mirrors and axes are believed
(`upright`). The principle is old (François, Medioni & Waupotitsch 2003, "Mirror
symmetry => 2-view stereo geometry").
"""
