// Prints what copc.js, which browsers use, reads of a COPC file: every node's points, and those outside of its cube.
import { Copc } from 'copc'

const file = process.argv[2]
const copc = await Copc.create(file)
const { nodes } = await Copc.loadHierarchyPage(file, copc.info.rootHierarchyPage)
const low = copc.info.cube.slice(0, 3)
const side = copc.info.cube[3] - low[0]
const found = { points: 0, outside: 0, nodes: 0, system: copc.wkt ?? '', attributes: copc.eb.map((extra) => extra.name) }
for (const [key, node] of Object.entries(nodes)) {
  const [depth, ...place] = key.split('-').map(Number)
  const view = await Copc.loadPointDataView(file, copc, node)
  const own = side / 2 ** depth
  const getters = ['X', 'Y', 'Z'].map((axis) => view.getter(axis))
  for (let i = 0; i < view.pointCount; i++) {
    const within = getters.map((get, k) => get(i) - (low[k] + place[k] * own))
    found.outside += within.some((d) => d < -1e-6 || d > own + 1e-6)
  }
  found.points += view.pointCount
  found.nodes += 1
}
console.log(JSON.stringify(found))
