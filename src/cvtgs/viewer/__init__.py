"""A browser page that shows a scene while the user chooses its size."""

from cvtgs.viewer.connection import check_viewer
from cvtgs.viewer.scenes import SceneViewer, ShownScene, camera_of
from cvtgs.viewer.server import ViewerServer, scene_page

__all__ = ["SceneViewer", "ShownScene", "ViewerServer", "camera_of", "check_viewer", "scene_page"]
