// What page.html.j2 uses of three.js 0.187.0; bundled and minified into three.min.js with esbuild 0.28.2:
// npm install three@0.187.0 esbuild@0.28.2
// npx esbuild three.entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none --outfile=three.min.js
export {
  BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, DirectionalLight, DoubleSide,
  Group, HemisphereLight, InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial,
  MeshLambertMaterial, MeshStandardMaterial, PerspectiveCamera, PlaneGeometry, Quaternion, Scene, SphereGeometry,
  Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
