"""What somebody may do to a dataset of an HDF5 file: each function replaces it in the open file."""

import h5py
import numpy as np

SECRET = b"the content of another file" * 1000


def removed(file, name):
    """Shape and number type of a dataset, which is then no longer there."""
    stored = file[name]
    shape, kind = (stored.shape or (1,)), stored.dtype if stored.dtype.kind in "iufb" else np.uint8
    del file[name]
    return shape, kind


def external_storage(file, name, other):
    file.create_dataset(name, *removed(file, name), external=[(str(other), 0, len(SECRET))])


def external_link(file, name, other):
    del file[name]
    file[name] = h5py.ExternalLink(str(other), name)


def soft_link(file, name, other):
    file.move(name, "elsewhere")
    file[name] = h5py.SoftLink("/elsewhere")


def virtual(file, name, other):
    shape, kind = removed(file, name)
    layout = h5py.VirtualLayout(shape, kind)
    layout[...] = h5py.VirtualSource(str(other), name, shape)
    file.create_virtual_dataset(name, layout)


def references(file, name, other):
    shape = file[name].shape
    del file[name]
    file.create_dataset(name, shape, h5py.ref_dtype)


def ragged(file, name, other):
    shape = file[name].shape
    del file[name]
    file.create_dataset(name, shape, h5py.vlen_dtype(np.int32))


def unknown_filter(file, name, other):
    shape, kind = removed(file, name)
    file.create_dataset(name, shape, kind, data=np.zeros(shape, kind), chunks=tuple(shape), compression="lzf")


def bomb(file, name, other):
    """A quarter of a petabyte that nothing is stored of."""
    shape, kind = removed(file, name)
    file.create_dataset(name, (1 << 48, *shape[1:]), kind, chunks=(1, *shape[1:]))


def other_shape(file, name, other):
    shape, kind = removed(file, name)
    file[name] = np.zeros((*shape, 2), kind)


def other_kind(file, name, other):
    shape = file[name].shape
    del file[name]
    file[name] = np.zeros(shape, np.complex64)


def a_group(file, name, other):
    del file[name]
    file.create_group(name)


def missing(file, name, other):
    del file[name]


WAYS = (external_storage, external_link, soft_link, virtual, references, ragged, unknown_filter, bomb, other_shape)
WAYS += (other_kind, a_group, missing)


def datasets(path):
    """Names of all datasets of a file."""
    found = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    return found
