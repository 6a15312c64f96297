"""Open3D is there without its viewer's libraries, and with them where the viewer is used."""

import subprocess
import sys

PROGRAM = """
import sys
from magic_core import viewerless

viewerless.prepare()
assert "open3d" not in sys.modules
import numpy as np
import open3d as o3d

assert "dash" not in sys.modules and "IPython" not in sys.modules
scene = o3d.t.geometry.RaycastingScene()
corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
scene.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(np.array([[0, 1, 2]], np.uint32)))
hit = scene.cast_rays(o3d.core.Tensor(np.array([[0.2, 0.2, 1, 0, 0, -1]], np.float32)))["t_hit"].numpy()
assert np.allclose(hit, 1.0)
mesh = o3d.geometry.TriangleMesh.create_box()
mesh.compute_vertex_normals()
figure = o3d.visualization.get_plotly_fig([mesh])
assert type(figure).__name__ == "Figure" and "dash" in sys.modules
viewerless.prepare()
import open3d.visualization.draw_plotly as viewer

assert viewer.__file__
"""


def test_the_viewer_is_imported_when_it_is_used_and_not_before():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
