// What all pages share: ?url=...&camera=x,y,z,tx,ty,tz in the axes of the scene (y down)
// &fov=degrees, of the height; errors and pictures go to the server.
export const query = new URLSearchParams(location.search);
export const eye = query.get("camera").split(",").map(Number);
export const target = eye.splice(3);
export const say = (...words) => fetch("/said", {method: "POST", body: words.join(" ")});
window.onerror = (event) => say("error:", event);
window.onunhandledrejection = (event) => say("error:", event.reason);

let frames = 0;
export function countFrame(canvas) {  // sends the picture of every twentieth frame
  if (++frames % 20 === 0) fetch("/picture", {method: "POST", body: canvas.toDataURL()});
}

export function cameraOfThree(THREE) {
  const camera = new THREE.PerspectiveCamera(+query.get("fov"), 640 / 480, 0.01, 1000);
  camera.up.set(0, -1, 0);
  camera.position.set(...eye);
  camera.lookAt(...target);
  camera.updateMatrixWorld();  // some sort the first frame before it is rendered
  return camera;
}
