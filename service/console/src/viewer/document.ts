// view.json as the engine writes it: metres from `offset_m`, in the coordinates of the points.
export type Point = [number, number, number];
export interface ViewImage {
  file: string;
  camera: string;
  unit: number;
  size_px: [number, number];
  frustum_m: Point[]; // centre, then the corners
  observations: [number, number]; // first byte and count in the file of observations
}
export interface ViewScene {
  name: string;
  color: string;
  units: number[];
  trajectory_m: Point[];
  longitude_latitude_deg?: [number, number][];
  images: ViewImage[];
}
export interface ViewDocument {
  version: number;
  epsg?: number;
  offset_m: Point;
  points: string;
  observations: string;
  scenes: ViewScene[];
  seams: { a: string; b: string; accepted: boolean; line_m?: [Point, Point] }[];
}
