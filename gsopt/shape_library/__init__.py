"""Shape libraries: the rest of an object that one photo shows, from shapes like it that an expert's words choose."""
