// The parts of three.js that the replay page uses. `make three` bundles them into three.bundle.js.
export {
  BufferAttribute, BufferGeometry, BoxGeometry, CanvasTexture, Color, DirectionalLight,
  HemisphereLight, InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, Mesh,
  MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, PlaneGeometry, Quaternion, Raycaster,
  Scene, Sprite, SpriteMaterial, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
