// Fly a mission with the unmodified npm ardrone-autonomy: climb, forward 1 m, turn by 90 degrees, hover, land.
const autonomy = require('ardrone-autonomy');

const mission = autonomy.createMission({ip: process.argv[2]});
mission.client().config('general:navdata_demo', 'TRUE');
mission.takeoff().zero().altitude(1.5).forward(1).cw(90).hover(500)
  .taskSync(() => {
    const {x, y, z, yaw} = mission.control().state();
    console.log(JSON.stringify({event: 'arrived', x, y, z, yaw}));
  })
  .land();
mission.run((error) => {
  console.log(JSON.stringify({event: error ? 'error' : 'landed', text: String(error)}));
  process.exit(error ? 1 : 0);
});
setTimeout(() => { console.log('{"event": "late"}'); process.exit(1); }, 90000);
