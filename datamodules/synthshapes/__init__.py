"""SynthShapes: parametric families of shapes, written as OFF files in ModelNet40's layout."""
