"""Datasets of labelled depth frames: recipes, the generator, and readers.

`recipe` says what a dataset is drawn from, `plan` draws it, `scenes` renders a scene and its frames, `shards` and
`making` write files, `reading` reads them.
"""
