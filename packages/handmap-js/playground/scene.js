// What is seen: the person's hand as bones, and the robot's links, side by side.

import * as THREE from "three";
import { OrbitControls } from "./three/OrbitControls.js";

const PERSON = 0xc9825b;
const ROBOT = 0x6f9cc4;
const BALL = 0xd9a400;
const APART = 0.11; // half the distance between both hands [m]
const BONES = [
  [0, 1], [1, 2], [2, 3], [3, 4], [0, 5], [5, 6], [6, 7], [7, 8], [5, 9], [9, 10], [10, 11], [11, 12],
  [9, 13], [13, 14], [14, 15], [15, 16], [13, 17], [17, 18], [18, 19], [19, 20], [0, 17],
];
const TIPS = [4, 8, 12, 16, 20];
const BONE_RADIUS = 0.0075; // [m]
const UP = new THREE.Vector3(0, 1, 0);

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a97a5, 3.0));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(0.5, 1.0, 1.0);
    this.scene.add(sun);
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.01, 10);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enablePan = false;
    this.person = new PersonShape();
    this.robot = new THREE.Group();
    this.robot.matrixAutoUpdate = false;
    this.scene.add(this.person.group, this.robot);
    this.links = new Map();
    this.look();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  /** Look at both hands from the front. */
  look() {
    this.camera.position.set(0, 0.06, 0.75);
    this.controls.target.set(0, 0.06, 0);
    this.controls.update();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // Both hands stay in the picture where it is narrow.
    this.camera.fov = Math.min(70, 32 * Math.max(1, 1.15 / this.camera.aspect));
    this.camera.updateProjectionMatrix();
  }

  /** Show the shapes of a robot, as `readShapes` returns them. */
  setRobot(shapes, linkNames) {
    this.robot.clear();
    this.links.clear();
    for (const { link, geometry, colour } of shapes) {
      const index = linkNames.indexOf(link);
      if (index < 0) continue;
      const tint = colour ? new THREE.Color(...colour) : new THREE.Color(ROBOT);
      const material = new THREE.MeshStandardMaterial({ color: tint, roughness: 0.7, side: THREE.DoubleSide, flatShading: true });
      const mesh = new THREE.Mesh(geometry, material);
      mesh.matrixAutoUpdate = false;
      this.robot.add(mesh);
      this.links.set(index, mesh);
    }
  }

  /**
   * Place both hands, each seen from the person's palm.
   * @param axes the world as it is shown, 16 numbers: its palm is at the origin, the fingers are up.
   */
  place(landmarks, linkPoses, axes) {
    const shown = matrixOf(axes);
    const left = new THREE.Matrix4().makeTranslation(-APART, 0, 0).multiply(shown);
    const right = new THREE.Matrix4().makeTranslation(APART, 0, 0).multiply(shown);
    this.person.place(landmarks, left);
    this.robot.matrix.copy(right);
    for (const [index, mesh] of this.links) mesh.matrix.copy(matrixOf(linkPoses.subarray(16 * index, 16 * index + 16)));
    this.robot.updateMatrixWorld(true);
  }

  /** Show a ball beside the robot, in axes of the palm as it is shown [m]; null for none. */
  placeBall(place, radius) {
    if (!this.ball) {
      const material = new THREE.MeshStandardMaterial({ color: BALL, roughness: 0.5 });
      this.ball = new THREE.Mesh(new THREE.SphereGeometry(1, 24, 16), material);
      this.scene.add(this.ball);
    }
    this.ball.visible = place !== null;
    if (!place) return;
    this.ball.scale.setScalar(radius);
    this.ball.position.set(APART + place[0], place[1], place[2]);
  }

  render() {
    this.renderer.render(this.scene, this.camera);
  }

  /** The person's fingertip under a pointer, a landmark's number, or null. */
  tipAt(x, y) {
    let best = null;
    let nearest = 36; // [px]
    for (const tip of TIPS) {
      const [px, py] = this.onScreen(this.person.points[tip]);
      const distance = Math.hypot(px - x, py - y);
      if (distance < nearest) [best, nearest] = [tip, distance];
    }
    return best;
  }

  /**
   * Let a pointer drag fingertips.
   * @param dragged returns the hand that is dragged, or null if pointers turn the camera.
   * @param axes returns the world as `place` has it.
   */
  listenToPointer(dragged, axes) {
    const { canvas, controls } = this;
    let tip = null;
    const place = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    // Before the controls of the camera, which would turn it.
    canvas.addEventListener("pointerdown", (event) => {
      if (!dragged()) return;
      tip = this.tipAt(...place(event));
      controls.enabled = tip === null;
      if (tip !== null) canvas.setPointerCapture(event.pointerId);
    }, { capture: true });
    canvas.addEventListener("pointermove", (event) => {
      if (tip !== null) dragged()?.drag(tip, this.pointAt(...place(event), tip, axes()));
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, () => {
        tip = null;
        controls.enabled = true;
        dragged()?.drag(0, null);
      });
    }
  }

  onScreen(point) {
    const at = point.clone().project(this.camera);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return [(0.5 + 0.5 * at.x) * width, (0.5 - 0.5 * at.y) * height];
  }

  /** Where a pointer is in the person's world, at the depth of a landmark; as `place` had the axes. */
  pointAt(x, y, landmark, axes) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2((2 * x) / width - 1, 1 - (2 * y) / height), this.camera);
    const facing = this.camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(facing, this.person.points[landmark]);
    const at = ray.ray.intersectPlane(plane, new THREE.Vector3());
    if (!at) return null;
    const back = new THREE.Matrix4().makeTranslation(-APART, 0, 0).multiply(matrixOf(axes)).invert();
    return at.applyMatrix4(back).toArray();
  }
}

/** A matrix of 16 numbers, row by row. */
export function matrixOf(numbers) {
  return new THREE.Matrix4().set(...numbers);
}

class PersonShape {
  constructor() {
    this.group = new THREE.Group();
    this.points = Array.from({ length: 21 }, () => new THREE.Vector3());
    const material = new THREE.MeshStandardMaterial({ color: PERSON, roughness: 0.8 });
    const bone = new THREE.CylinderGeometry(BONE_RADIUS, BONE_RADIUS, 1, 12);
    const ball = new THREE.SphereGeometry(BONE_RADIUS, 16, 12);
    this.bones = BONES.map(() => new THREE.Mesh(bone, material));
    this.balls = this.points.map(() => new THREE.Mesh(ball, material));
    this.group.add(...this.bones, ...this.balls);
  }

  place(landmarks, axes) {
    for (let i = 0; i < 21; i += 1) {
      this.points[i].fromArray(landmarks, 3 * i).applyMatrix4(axes);
      this.balls[i].position.copy(this.points[i]);
      this.balls[i].scale.setScalar(TIPS.includes(i) ? 1.35 : 1.0);
    }
    BONES.forEach(([from, to], k) => {
      const along = this.points[to].clone().sub(this.points[from]);
      const bone = this.bones[k];
      bone.position.copy(this.points[from]).addScaledVector(along, 0.5);
      bone.scale.set(1, Math.max(along.length(), 1e-6), 1);
      bone.quaternion.setFromUnitVectors(UP, along.normalize());
    });
  }
}

/** Shapes of a robot's links, as `pack.py` writes them. */
export function readShapes(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const links = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  let at = 4 + size;
  return links.map(({ link, colour, vertices, faces }) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(buffer, at, 3 * vertices), 3));
    at += 12 * vertices;
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(buffer, at, 3 * faces), 1));
    at += 12 * faces;
    return { link, colour, geometry };
  });
}
