// Fly each drone whose address is given with the unmodified npm ar-drone: take off, turn, fly ahead, hover, land.
// Prints a line of JSON for each thing that happens.
const ardrone = require('ar-drone');

const say = (ip, event, more) => console.log(JSON.stringify({ip, event, ...more}));
let left = process.argv.length - 2;

for (const ip of process.argv.slice(2)) {
  const client = ardrone.createClient({ip});
  let newest = {};
  client.on('navdata', (navdata) => { newest = navdata.demo ? navdata : newest; });
  client.on('error', (error) => say(ip, 'error', {text: error.message}));
  client.config('general:navdata_demo', 'FALSE', () => {
    say(ip, 'configured');
    client.takeoff(() => {
      say(ip, 'hovering', {altitude: newest.demo.altitudeMeters});
      client.front(0.5);
      client.after(2000, function() {
        say(ip, 'flying', {state: newest.demo.controlState, speed: newest.demo.velocity.x, pitch: newest.demo.rotation.pitch,
          magneto: newest.magneto.heading.fusionUnwrapped, motors: newest.pwm.motors});
        this.stop();
      }).after(2000, function() {
        say(ip, 'stopped', {state: newest.demo.controlState, speed: newest.demo.velocity.x, x: newest.demo.velocity.x});
        this.land(() => {
          say(ip, 'landed', {altitude: newest.demo.altitudeMeters, battery: newest.demo.batteryPercentage});
          if (--left === 0) process.exit(0);
        });
      });
    });
  });
}
setTimeout(() => { console.log('too late'); process.exit(1); }, 60000);
