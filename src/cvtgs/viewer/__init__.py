"""A page in the browser that shows a scene while its size is chosen."""

from cvtgs.viewer.nodes import check_viewer, scene_page
from cvtgs.viewer.scenes import SceneViewer, ShownScene, camera_of
from cvtgs.viewer.server import ViewerServer

__all__ = ["SceneViewer", "ShownScene", "ViewerServer", "camera_of", "check_viewer", "scene_page"]
