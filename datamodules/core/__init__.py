"""Common parts of all data sets: files -> images -> samples -> loaders.

A data set is one class. Its fields are its settings, checked by their types::

    @data_set
    class Mine(PanoramaDataModule):  # or PhotoDataModule
        label_maps = {"3": LabelMap.of(["sky", "wall", "ground"], unknown=[0])}

        lighting: Literal["day", "night"] = "day"  # the setting data.lighting

        def files(self) -> dict[Split, list[ImageFiles]]:
            folder = self.root / self.lighting
            return {s: [ImageFiles(p.stem, p, ...) for p in (folder / s).glob(...)] for s in SPLITS}

`files` lists all splits without opening files.
Problems and warnings of folders go to `self.problems`. Label images are read with the label map;
`decode_labels`, `decode_depth`, `decode_camera` or `decode` read other formats. `cache_settings`
names the settings that the decoded arrays depend on. `normalizations`, `units_per_m`,
`no_depth`, `no_distances`, `folds`, `fact_settings` and `groups` describe the data set further.

The way of a file to a sample: `ImageDataModule.decode` (as stored) -> `read` (size of the run,
kept in the `cache`) -> `finish` (placed on the sphere, masked, rotated, aligned) ->
`ImageDataset.sample` (views of a representation) -> loaders of `DataModule`.
"""
