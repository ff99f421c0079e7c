"""Mirror symmetry: what few photos do not show of one half they often show of the other.

Most things that people make, and many that grow, are symmetric. From the silhouettes of 4 photos alone follows whether
an object is, and the plane of its mirror to a fraction of a degree: `search` finds candidates, `silhouettes` refines
and judges them, `colors` says whether the paint is symmetric too. Each photo then counts once more for every mirror,
as the picture that a camera behind that mirror takes (`find`). That a picture of something symmetric is worth two
pictures is old (François, Medioni & Waupotitsch 2003, "Mirror symmetry => 2-view stereo geometry").
"""
