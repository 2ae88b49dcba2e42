"""Writes the golden pickles beside this file: run it with Python 3 and with Python 2.7, each with numpy.

The values are the ones of a HO-3D annotation in shape and type: a camera matrix, an axis-angle column of float32,
a translation of float64, a name, and things that a reader of poses has to step over.
"""
import collections
import os
import pickle
import sys

import numpy as np

META = {
    "camMat": np.array([[614.627, 0.0, 320.262], [0.0, 614.101, 238.469], [0.0, 0.0, 1.0]]),
    "objRot": np.array([[0.5], [-1.25], [2.0]], dtype=np.float32),
    "objTrans": np.array([0.0625, -0.03125, -0.5]),
    "objName": "019_pitcher_base",
    "objLabel": 12,
    "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
    "big": np.array([1.5, -2.5], dtype=">f4"),
    "flags": np.array([True, False]),
    "scalar": np.float64(0.1),
    "empty": np.zeros((0, 3)),
    "objects": np.array(None, dtype=object),
    "nothing": None,
    "list": [1, 2.5, -3],
    "ordered": collections.OrderedDict([("a", 1)]),
    "bytes": b"\x00\n'\\\xff",
}

version = sys.version_info[0]
for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
    name = "py%d_protocol%d.pkl" % (version, protocol)
    with open(os.path.join(os.path.dirname(os.path.abspath(__file__)), name), "wb") as file:
        pickle.dump(META, file, protocol)
